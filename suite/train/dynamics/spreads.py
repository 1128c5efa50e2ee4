"""What a recipe varies of its dynamics: by name, taken away, and as vehicles for environments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from eval.vehicles.vehicle import Vehicle, with_effects
from suite.train.config import PointMassConfig, QuadrotorConfig, TrainConfig
from suite.train.overrides import in_every_phase, phase_configs

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
    """
    part = "physics" if config.quadrotor is None else "quadrotor"
    settings = _of_point_mass(config.physics) if config.quadrotor is None else QUADROTOR
    named = [(name, part, changes) for name, changes in settings.items()]
    found = {
        name: in_every_phase(config, part, **changes)
        for name, part, changes in [*named, ("image", "physics", IMAGE)]
    }
    return {name: without for name, without in found.items() if without != config}


def fixed(config: TrainConfig) -> TrainConfig:
    """Return `config` without any of its spreads."""
    for name in spreads(config):
        config = spreads(config)[name]
    return config


@dataclass(frozen=True)
class DrawnVehicle:
    """A function that draws a vehicle, as the trainer draws one for each world."""

    config: QuadrotorConfig
    """The vehicle and how far what varies is spread."""

    def __call__(self, rng: np.random.Generator) -> Vehicle:
        """Return the vehicle with drawn values of its effects."""
        # The trainer of the point mass stays clear of the judge's physics.
        from suite.train.dynamics.quadrotor import draw_effects

        drawn = {
            name: type(values)(*(np.asarray(value, float)[0].tolist() for value in values))
            for name, values in draw_effects(self.config, 1, rng).items()
        }
        return with_effects(self.config.vehicle, drawn)


def race_settings(recipe: str, vehicle: str = "racer5") -> dict[str, Any]:
    """Return arguments of the environments in `eval.envs` for training as by a recipe.

    They are what its policy observes (`spec`), and vehicles (`vehicle`) that vary as in its
    training, or by the usual spreads where it trains through a point mass.

    Args:
        recipe: a name of `suite train`.
        vehicle: a file or a shipped name, around which is drawn.

    Raises:
        ValueError: for an unknown recipe or vehicle.
    """
    from eval.quadrotor.vehicle_file import load_vehicle
    from suite.train.recipes import named_recipe, with_quadrotor

    last = phase_configs(named_recipe(recipe))[-1]
    config = with_quadrotor(last, load_vehicle(vehicle))
    assert config.quadrotor is not None
    return {"spec": config.spec, "vehicle": DrawnVehicle(config.quadrotor)}


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
