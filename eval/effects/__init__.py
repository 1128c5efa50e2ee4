"""The catalogue of physical effects; adding one is adding its file and its name here.

Another package adds one with an entry point of the group `diffracing_suite.effects`, a program for
its own process with `EFFECTS.register(effect.name, effect)`.
"""

from __future__ import annotations

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
    rotor_spin_up,
    slung_load,
    thrust_scale,
    thrust_tilt,
    torque_trim,
    translational_lift,
    weak_motor,
)
from eval.effects.interface import Effect, as_arrays, neutral
from tracks.common.names import Registry

if TYPE_CHECKING:
    from eval.vehicles.vehicle import Vehicle


def _wrong(name: str, effect: Any) -> str | None:
    if not isinstance(effect, Effect):
        return f"a {type(effect).__name__}; must be an eval.effects.interface.Effect"
    if effect.name != name:
        return f"its Effect is called {effect.name!r}; both names must be the same"
    if (effect.start is None) != (effect.carry is None):
        return "a memory with only one of `start` and `carry`; it needs both"
    if not effect.in_flight and any(callable(p.neutral) for p in effect.parameters):
        return "a fault of the log; its neutral values must be numbers"
    fields, names = getattr(effect.values, "_fields", ()), tuple(p.name for p in effect.parameters)
    if fields != names:
        return (
            f"its values ({effect.values.__name__}) have the fields {list(fields)} and its "
            f"parameters the names {list(names)}; both must be the same, in the same order"
        )
    return None


_OWN = {
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
        rotor_spin_up,
        rate_gain,
        angular_damping,
        weak_motor,
        thrust_tilt,
        gyro_bias,
        accelerometer_bias,
        frame_tilt,
        clock_offset,
        slung_load,
    )
}
# In the order in which they act: what scales a thrust stands after what adds to it, and random
# wind after the steady wind that it is relative to; what other packages add acts last.
EFFECTS: Registry[Effect] = Registry("effect", "diffracing_suite.effects", _OWN, _wrong)


def find_effect(name: str) -> Effect:
    """Return the effect called `name`.

    Raises:
        ValueError: for an unknown name, with the nearest one.
    """
    return EFFECTS.find(name)


def nameable_effects() -> list[str]:
    """Return the names of the effects that a diagnosis may name, in the catalogue's order."""
    return [name for name, effect in EFFECTS.items() if effect.nameable]


def all_values(vehicle: Vehicle) -> dict[str, Any]:
    """Return values of every effect by name: the vehicle's own, and neutral ones for the others.

    The result is a pytree of numpy arrays: one model with it holds the whole catalogue.
    """
    return {
        name: as_arrays(vehicle.effects.get(name, neutral(effect, vehicle)))
        for name, effect in EFFECTS.items()
    }
