"""What a recipe varies of its dynamics, name by name, and the same recipe without it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from suite.train.config import PointMassConfig, QuadrotorConfig, TrainConfig

STILL = (0.0, 0.0, 0.0)
"""No wind."""
QUADROTOR: dict[str, dict[str, Any]] = {
    "mass": {"mass_std": 0.0},
    "thrust": {"thrust_spread": 0.0},
    "rotor lag": {"lag_spread": 0.0, "lag_spread_s": 0.0},
    "drag": {"drag_spread": 0.0},
    "delay": {"delay_spread_s": 0.0},
    "rate gain": {"gain_spread": 0.0},
    "centre of mass": {"com_std_m": 0.0},
    "torque trim": {"trim_std": 0.0},
    "wind": {"wind_std": STILL},
}
"""Settings of `QuadrotorConfig` that leave the vehicle as its file says."""
IMAGE = {"depth_noise": 0.0, "fov_scale": (1.0, 1.0)}
"""Settings of `PointMassConfig` that quadrotors heed as well."""


def spreads(config: TrainConfig) -> dict[str, TrainConfig]:
    """Return `config` without each of the spreads that it has, by the spread's name.

    What is drawn from a range has the range's middle instead; what is drawn around the vehicle's
    own has that.

    Raises:
        ValueError: for a fleet, whose distribution is not made of such spreads.
    """
    if config.fleet is not None:
        raise ValueError(
            "a fleet is drawn as a whole, nothing of it can be left out; give a recipe through "
            "one vehicle's quadrotors or through the point mass"
        )
    quadrotor, physics = config.quadrotor, config.physics
    found: dict[str, TrainConfig]
    if quadrotor is not None:
        found = {
            name: replace(config, quadrotor=replace(quadrotor, **changes))
            for name, changes in QUADROTOR.items()
        }
    else:
        found = {
            name: replace(config, physics=replace(physics, **changes))
            for name, changes in _of_point_mass(physics).items()
        }
    found["image"] = replace(config, physics=replace(physics, **IMAGE))
    return {name: without for name, without in found.items() if without != config}


def fixed(config: TrainConfig) -> TrainConfig:
    """Return `config` without any of its spreads; raises as `spreads` does."""
    for name in spreads(config):
        config = spreads(config)[name]
    return config


def words(config: TrainConfig) -> str:
    """Return in words between what the dynamics of `config` vary."""
    physics, quadrotor = config.physics, config.quadrotor
    both = "field of view, noise of the image"
    if quadrotor is None:
        low, high = physics.drag
        least, most = physics.drag_up
        first, last = physics.action_delay
        return (
            f"lag {physics.lag_mean:g} +- {physics.lag_std:g} 1/s, drag {low:g} to {high:g} 1/s "
            f"({least:g} to {most:g} along z), delay {first:g} to {last:g} decisions, "
            f"wind {physics.wind_std[0]:g} m/s, time step {100 * physics.time_step_std:g} %, {both}"
        )
    return f"around {quadrotor.vehicle.name}: {_of_quadrotor(quadrotor)}, {both}"


def _of_quadrotor(config: QuadrotorConfig) -> str:
    return (
        f"mass {100 * config.mass_std:g} %, thrust {100 * config.thrust_spread:g} %, rotor lag "
        f"{100 * config.lag_spread:g} % and {1e3 * config.lag_spread_s:g} ms, drag "
        f"{config.drag_spread:g} 1/s, delay {1e3 * config.delay_spread_s:g} ms, rate gain "
        f"{100 * config.gain_spread:g} %, centre of mass {1e3 * config.com_std_m:g} mm, torque "
        f"trim {config.trim_std:g} N m, wind {config.wind_std[0]:g} m/s"
    )


def _of_point_mass(physics: PointMassConfig) -> dict[str, dict[str, Any]]:
    def middle(bounds: tuple[float, float]) -> tuple[float, float]:
        centre = sum(bounds) / 2
        return centre, centre

    return {
        "rotor lag": {"lag_std": 0.0},
        "drag": {"drag": middle(physics.drag), "drag_up": middle(physics.drag_up)},
        "delay": {"action_delay": middle(physics.action_delay)},
        "wind": {"wind_std": STILL},
        "time step": {"time_step_std": 0.0},
    }
