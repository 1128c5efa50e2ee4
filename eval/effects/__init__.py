"""The catalogue of physical effects; adding one is adding its file and its name here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from eval.effects import (
    accelerometer_bias,
    angular_damping,
    battery_sag,
    blade_flapping,
    clock_offset,
    com_offset,
    command_delay,
    constant_wind,
    frame_tilt,
    ground_effect,
    gusts,
    gyro_bias,
    inertia_scale,
    inflow,
    linear_drag,
    mass_offset,
    motor_lag,
    quadratic_drag,
    rate_gain,
    rotor_drag,
    rotor_gyroscopic,
    thrust_scale,
    thrust_tilt,
    torque_trim,
    translational_lift,
    weak_motor,
)
from eval.effects.interface import Array, Effect, as_arrays, neutral
from tracks.common.names import unknown_name

if TYPE_CHECKING:
    from eval.vehicles.vehicle import Vehicle

# In the order in which they act: what scales a thrust stands after what adds to it, and random
# wind after the steady wind that it is relative to.
EFFECTS: dict[str, Effect] = {
    module.EFFECT.name: module.EFFECT
    for module in (
        linear_drag,
        quadratic_drag,
        rotor_drag,
        inflow,
        translational_lift,
        blade_flapping,
        ground_effect,
        constant_wind,
        gusts,
        motor_lag,
        command_delay,
        thrust_scale,
        battery_sag,
        mass_offset,
        com_offset,
        torque_trim,
        inertia_scale,
        rotor_gyroscopic,
        rate_gain,
        angular_damping,
        weak_motor,
        thrust_tilt,
        gyro_bias,
        accelerometer_bias,
        frame_tilt,
        clock_offset,
    )
}


def find_effect(name: str) -> Effect:
    """Return the effect called `name`.

    Raises:
        ValueError: for an unknown name, with the nearest one.
    """
    if name not in EFFECTS:
        raise unknown_name("effect", name, EFFECTS)
    return EFFECTS[name]


def apply_log_faults(effects: Mapping[str, object], log: Mapping[str, Array]) -> dict[str, Array]:
    """Return the arrays of `log` (T rows, by their names in a flight log) with every fault applied.

    Args:
        effects: the vehicle's effects; those that are no fault of a log are passed over.
        log: `time_s` (T,), `pos_w` (T, 3), `quat_wxyz` (T, 4), `vel_w`, `rate_b` and, where
            there is one, `acc_b`; other entries are kept. A log's or a flight's own fields fit.
    """
    log = dict(log)
    for effect in EFFECTS.values():
        if effect.log is not None and effect.name in effects:
            log.update(effect.log(effects[effect.name], log))
    return log


def all_values(vehicle: Vehicle) -> dict[str, Any]:
    """Return values of every effect by name: the vehicle's own, and neutral ones for the others.

    The result is a pytree of numpy arrays: one model with it holds the whole catalogue.
    """
    return {
        name: as_arrays(vehicle.effects.get(name, neutral(effect, vehicle)))
        for name, effect in EFFECTS.items()
    }
