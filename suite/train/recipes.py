"""Recipes: named sets of all settings of a training, for `suite train --recipe NAME`.

The functions after the recipes return a recipe with another vehicle or sensors. The judge,
which the docstrings mention, is the independent simulator that scores the policies. The paper is
Su et al. 2026. The meaning of each setting is in `config.py`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from eval.vehicles.vehicle import Vehicle
from policies.spec import PolicySpec
from suite.train.config import (
    COM_STD_MOST,
    TRIM_STD_MOST,
    EpisodeConfig,
    LossConfig,
    OptimizerConfig,
    Phase,
    PointMassConfig,
    QuadrotorConfig,
    SensorsConfig,
    TrainConfig,
    check_decides_in_time,
)
from suite.train.overrides import phase_configs, without_quadrotor
from tracks.common.names import unknown_name
from tracks.geometry.camera import Camera
from tracks.input.ranges import check_type


def race_paper() -> TrainConfig:
    """Return the recipe of `race-paper`: the point mass, and the paper's state of 12 numbers.

    The loss and the tracks are those of the first phase of `race`, but acceleration and jerk cost
    more: with the weights of `race`, its policy fails more often and is no faster.
    """
    base = race()
    return TrainConfig(
        loss=replace(base.loss, acceleration=1e-2, jerk=1e-3),
        episode=base.episode,
        optimizer=OptimizerConfig(iterations=2500),
    )


def race() -> TrainConfig:
    """Return the recipe of `race`, the default policy: three phases from random weights.

    The first phase learns safe flight at 15 decisions a second, where a gradient step costs least.
    The second phase learns speed: the weight of progress is higher, those of acceleration and jerk
    are lower. The third phase has 30 decisions a second and delays of up to 80 ms. Its weight of
    tilt is higher, since tipping over ends a trial of the judge. The quadrotors vary widely around
    the vehicle `racer5`, which no result table uses.
    """
    second_phase = (
        "loss.progress=2.2",
        "loss.acceleration=2e-3",
        "loss.jerk=1e-4",
        "loss.tilt=20.0",
        "episode.race_share=0.8",
        "optimizer.rate=1e-3",
    )
    third_phase = (
        "spec.rate_hz=30.0",
        "episode.steps=180",
        "episode.image_stride=6",
        "quadrotor.delay_spread_s=0.08",
        "loss.progress=1.7",
        "loss.tilt=40.0",
        "episode.race_share=0.6",
        "optimizer.rate=4e-4",
    )
    return TrainConfig(
        spec=PolicySpec(
            rate_hz=15.0,
            camera=Camera(rays=2),
            second_gate=True,
            gate_axis=True,
            second_axis=True,
            speed_input=True,
        ),
        physics=PointMassConfig(drag_up=(0.2, 2.0)),
        quadrotor=replace(_racer5_with_spreads(), attitude_hz=60.0, physics_hz=120.0),
        loss=LossConfig(
            clearance=4.2,
            collide=0.28,
            acceleration=5e-3,
            jerk=4e-4,
            progress=1.6,
            approach_m=1.5,
            pass_first=True,
            safety_radius_m=0.3,
            gradient_decay=1.4,
        ),
        episode=EpisodeConfig(
            missed_share=0.3,
            density=(0.3, 1.5),
            bare_share=0.1,
            sharp_share=0.7,
            hairpin_share=0.35,
            height_spread=2.0,
            finish=True,
            image_stride=3,
        ),
        optimizer=OptimizerConfig(iterations=4500),
        # 1300, 1100 and 2100 gradient steps.
        phases=(Phase(13 / 45), Phase(11 / 45, second_phase), Phase(21 / 45, third_phase)),
    )


def race_small() -> TrainConfig:
    """Return the recipe of `race-small`: as `race`, for a network of under 100,000 weights."""
    base = race()
    return replace(base, spec=replace(base.spec, channels=(16, 32, 32), hidden_size=96))


def paper() -> TrainConfig:
    """Return the loss weights of Su et al. 2026 and the point mass of Zhang et al. 2025.

    The paper does not say how its attractive field u_A scales with batch and horizon. Here u_A is
    added as written to the gradient of a loss averaged over 64 worlds of 150 steps.
    """
    return TrainConfig(
        spec=PolicySpec(rate_hz=15.0),
        physics=PointMassConfig(
            lag_mean=12.0,
            lag_std=1.2,
            drag=(0.30, 0.45),
            drag_up=(0.30, 0.45),
            action_delay=(0.0, 0.0),
            state_delay=1,
            image_delay=2,
        ),
        loss=LossConfig(
            collide=3.0,
            acceleration=1e-2,
            jerk=1e-3,
            progress=0.4,
            safety_radius_m=0.15,
            field_gain=64 * 150 * 2.807e-3,
            crash_depth_m=math.inf,
        ),
        episode=EpisodeConfig(steps=150, rest_share=1.0, stop_from=1.0),
        optimizer=OptimizerConfig(iterations=50_000, rate=1e-3, memory=0.999, clip=0.0, warmup=0),
    )


def quick() -> TrainConfig:
    """Return a run of minutes on two cores, through the point mass; its policy flies slowly."""
    base = TrainConfig()
    return replace(
        base,
        episode=replace(base.episode, batch=48),
        optimizer=replace(base.optimizer, iterations=300),
    )


def gpu() -> TrainConfig:
    """Return the recipe of `race` with 2,048 environments at once, for one GPU.

    It has one shard, because a small batch takes a GPU as long as a large one.
    """
    base = race()
    return replace(base, episode=replace(base.episode, batch=2048, shards=1))


def with_iterations(config: TrainConfig, iterations: int) -> TrainConfig:
    """Return `config` with another number of gradient steps."""
    return replace(config, optimizer=replace(config.optimizer, iterations=iterations))


def finetune(config: TrainConfig) -> TrainConfig:
    """Return the settings of fine-tuning a policy that was trained with `config`.

    They are those of the last phase, with a quarter of its gradient steps, a lower learning rate
    and other tracks.
    """
    last = phase_configs(config)[-1]
    optimizer = last.optimizer
    return replace(
        last,
        optimizer=replace(
            optimizer,
            iterations=max(1, round(0.25 * optimizer.iterations)),
            rate=0.3 * optimizer.rate,
        ),
        seed=config.seed + 1,
    )


def with_sensors(config: TrainConfig, sensors: str) -> TrainConfig:
    """Return `config` with the sensor models of a file or a shipped name.

    Raises:
        ValueError: for invalid sensors, for ones that need the judge's state estimator, and for
            models that do not change the observation.
    """
    from eval.sensors import view_models
    from eval.sensors.sensors_file import load_sensors

    seen = load_sensors(sensors)
    if seen.estimator:
        raise ValueError(
            f"--sensors {sensors}: its estimator follows flights of the judge, not of the "
            "trainer; train with vio, or with what suite identify --sensors writes"
        )
    if not seen.models and seen.name != "perfect":
        raise ValueError(
            f"--sensors {sensors}: the file has no sensor model; add one or leave it out"
        )
    acting = {name: seen.models[name] for name in seen.models if name not in seen.without_effect}
    if seen.models and not view_models(acting) and not seen.has_delay:
        raise ValueError(
            f"--sensors {sensors}: {', '.join(seen.models)} does not change what a policy sees, so "
            "training with it has no effect; leave --sensors out"
        )
    return replace(config, sensors=SensorsConfig(seen))


def with_quadrotor(config: TrainConfig, vehicle: Vehicle) -> TrainConfig:
    """Return `config` with training through the quadrotor of `vehicle`; the randomisation stays.

    Only the spreads of the centre of mass and of the constant torque (trim) are scaled with the
    vehicle's size: a torque that is small for a racer is more than a palm-sized quadrotor can
    produce.

    Raises:
        ValueError: if the policy decides faster than the vehicle's controller runs.
    """
    check_decides_in_time(config.spec, vehicle)
    quadrotor = config.quadrotor or QuadrotorConfig(vehicle)
    arm_ratio = _arm_m(vehicle) / _arm_m(quadrotor.vehicle)
    inertia_ratio = _inertia(vehicle) / _inertia(quadrotor.vehicle)
    quadrotor = replace(
        quadrotor,
        vehicle=vehicle,
        com_std_m=min(arm_ratio * quadrotor.com_std_m, COM_STD_MOST),
        trim_std=min(inertia_ratio * quadrotor.trim_std, TRIM_STD_MOST),
    )
    return replace(config, quadrotor=quadrotor)


SPREADS = (
    *("mass_std", "lag_spread_s", "drag_spread", "delay_spread_s"),
    *("gain_spread", "thrust_spread", "com_std_m", "trim_std"),
)
"""Settings of the randomisation that `with_usual_spreads` increases."""


def with_usual_spreads(config: TrainConfig) -> TrainConfig:
    """Return `config` with quadrotors that vary by at least the usual errors of a vehicle file.

    A policy that is fine-tuned through one exact vehicle loses its robustness: with a hidden offset
    of the centre of mass its success rate fell far below that before the fine-tuning.
    """
    quadrotor = config.quadrotor
    if quadrotor is None:
        return config
    # Usual spreads for `racer5`, then scaled to the vehicle.
    base = replace(_racer5_with_spreads(), com_std_m=0.008, trim_std=0.03)
    usual = with_quadrotor(replace(config, quadrotor=base), quadrotor.vehicle).quadrotor
    spreads = {name: max(getattr(quadrotor, name), getattr(usual, name)) for name in SPREADS}
    return replace(config, quadrotor=replace(quadrotor, **spreads))


def _racer5_with_spreads() -> QuadrotorConfig:
    """Return quadrotors that vary widely around `racer5`."""
    from eval.quadrotor.vehicle_file import load_vehicle

    return QuadrotorConfig(
        load_vehicle("racer5"),
        mass_std=0.08,
        lag_spread_s=0.03,
        drag_spread=0.5,
        delay_spread_s=0.07,
        gain_spread=0.3,
        thrust_spread=0.1,
        com_std_m=0.003,
        trim_std=0.01,
    )


def _arm_m(vehicle: Vehicle) -> float:
    """Return the mean distance of the hubs from the origin in the x-y plane [m]."""
    return sum(math.hypot(x, y) for x, y, _ in vehicle.rotors.position) / 4


def _inertia(vehicle: Vehicle) -> float:
    """Return the mean of the inertias about x and y [kg m^2]."""
    return (vehicle.inertia[0] + vehicle.inertia[1]) / 2


def with_model(config: TrainConfig, model: str | None, vehicle: str | None) -> TrainConfig:
    """Return `config` with the dynamics that the options --model and --vehicle choose.

    The model is "point" or "quad", and the vehicle of a quadrotor a file or a shipped name. None
    keeps that of the recipe.

    Raises:
        ValueError: for a point mass with a vehicle, "quad" without one for a recipe with the point
            mass, or an invalid vehicle.
    """
    from eval.quadrotor.vehicle_file import load_vehicle, shipped_vehicles

    if model == "point" or (model is None and config.quadrotor is None):
        if vehicle is not None:
            raise ValueError(
                f"--vehicle is {vehicle}, but the point mass has none: add --model quad"
            )
        return without_quadrotor(config)
    if vehicle is not None:
        return with_quadrotor(config, load_vehicle(vehicle))
    if config.quadrotor is not None:
        return config
    raise ValueError(
        "--model quad needs --vehicle, since this recipe has the point mass: add --vehicle racer5, "
        f"another shipped vehicle ({', '.join(shipped_vehicles())}) or a vehicle file"
    )


RECIPES = {
    "race": race,
    "race-small": race_small,
    "race-paper": race_paper,
    "quick": quick,
    "paper": paper,
    "gpu": gpu,
}
"""Name of a recipe -> function that returns its settings; its docstring describes the recipe."""


def named_recipe(name: str) -> TrainConfig:
    """Return the recipe `name`.

    Raises:
        ValueError: if there is none, with the known names.
    """
    check_type("recipe", name, (str,), "a name, as a text")
    if name not in RECIPES:
        raise unknown_name("recipe", name, RECIPES)
    return RECIPES[name]()


def race_settings(recipe: str, vehicle: str = "racer5") -> dict[str, Any]:
    """Return arguments of the environments in `eval.envs`, to train another learner like a recipe.

    They are `spec`, the policy's observation, and `vehicle`, a function that draws vehicles with
    the recipe's randomisation. A recipe through a point mass gets the default randomisation. The
    centre of the randomisation is `vehicle`, a file or a shipped name.

    Raises:
        ValueError: for an unknown recipe or vehicle.
    """
    from eval.quadrotor.vehicle_file import load_vehicle
    from suite.train.dynamics.quadrotor import DrawnVehicle

    last = phase_configs(named_recipe(recipe))[-1]
    config = with_quadrotor(last, load_vehicle(vehicle))
    assert config.quadrotor is not None
    return {"spec": config.spec, "vehicle": DrawnVehicle(config.quadrotor)}
