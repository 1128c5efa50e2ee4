"""The catalogue of effects: physical causes of a mismatch between a vehicle and its nominal model.

The files of this folder group the effects by cause. To add an effect, write its `Effect` and list
it here. Another package adds one with an entry point of the group `diffracing_suite.effects`. A
program adds one for its own process with `EFFECTS.register(effect.name, effect)`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from eval.effects import (
    body,
    drag,
    measurement,
    response,
    rotors,
    slung_load,
    thrust,
    weak_motor,
    wind,
)
from eval.effects.interface import SIGNALS, Effect, as_arrays, neutral
from tracks.common.names import Registry

if TYPE_CHECKING:
    from eval.vehicles.vehicle import Vehicle


def _registration_error(name: str, effect: Any) -> str | None:
    """Return why `effect` cannot be registered under `name`, or None."""
    if not isinstance(effect, Effect):
        return f"a {type(effect).__name__}; must be an eval.effects.interface.Effect"
    if effect.name != name:
        return f"its Effect is called {effect.name!r}; both names must be the same"
    if unknown := [signal for signal in effect.needs if signal not in SIGNALS]:
        return f"needs {unknown}; allowed is a tuple of {', '.join(SIGNALS)}"
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
    # Imported here, because only effects of other programs need it.
    from eval.effects.hook_check import hook_problem, parameter_problem

    return parameter_problem(effect) or hook_problem(effect)


_BUILT_IN = (
    drag.LINEAR_DRAG,
    drag.QUADRATIC_DRAG,
    drag.ROTOR_DRAG,
    drag.HUB_DRAG,
    rotors.INFLOW,
    rotors.TRANSLATIONAL_LIFT,
    rotors.BLADE_FLAPPING,
    rotors.GROUND_EFFECT,
    wind.CONSTANT_WIND,
    wind.GUSTS,
    response.MOTOR_LAG,
    response.COMMAND_DELAY,
    thrust.THRUST_SCALE,
    thrust.BATTERY_SAG,
    body.MASS_OFFSET,
    body.COM_OFFSET,
    body.TORQUE_TRIM,
    body.INERTIA_SCALE,
    rotors.ROTOR_GYROSCOPIC,
    rotors.ROTOR_SPIN_UP,
    response.RATE_GAIN,
    drag.ANGULAR_DAMPING,
    weak_motor.WEAK_MOTOR,
    thrust.THRUST_TILT,
    measurement.LEVER_ARM,
    measurement.ATTITUDE_OFFSET,
    measurement.GYRO_BIAS,
    measurement.ACCELEROMETER_BIAS,
    measurement.FRAME_TILT,
    measurement.CLOCK_OFFSET,
    slung_load.SLUNG_LOAD,
)
"""The suite's effects in the order in which they act. An effect that scales a thrust follows the
effects that add to the thrust. Random wind follows the steady wind that it is added to. Effects of
other packages act last."""
EFFECTS: Registry[Effect] = Registry(
    "effect",
    "diffracing_suite.effects",
    {effect.name: effect for effect in _BUILT_IN},
    _registration_error,
)
"""All effects by name, those of other packages included."""


def nameable_effects() -> list[str]:
    """Return the names of the effects that a diagnosis may name, in the catalogue's order."""
    return [name for name, effect in EFFECTS.items() if effect.nameable]


def all_values(vehicle: Vehicle) -> dict[str, Any]:
    """Return values of every effect by name: the vehicle's, and neutral ones for other effects.

    The result is a pytree of numpy arrays, with which one model contains the whole catalogue.
    """
    return {
        name: as_arrays(vehicle.effects.get(name, neutral(effect, vehicle)))
        for name, effect in EFFECTS.items()
    }


def without_signal(vehicle: Vehicle) -> list[str]:
    """Return a sentence for each effect that does not act on simulated flights and trainings.

    These have neither a battery voltage nor an accelerometer; log faults change recorded logs.
    """
    notes = []
    for name, values in vehicle.effects.items():
        effect, absent = EFFECTS[name], neutral(EFFECTS[name], vehicle)
        changed = [
            parameter
            for parameter, value, other in zip(effect.parameters, values, absent, strict=True)
            if np.any(np.asarray(value) != np.asarray(other))
        ]
        if changed and all(parameter.voltage for parameter in changed):
            instead = " or ".join(p.name for p in effect.parameters if p.voltage is False)
            notes.append(f"{name}: acts only on logs with a voltage; for flights give {instead}")
        elif changed and not effect.in_flight and "acc_b" in effect.needs:
            notes.append(f"{name}: acts only on logs with an accelerometer; flights here have none")
        elif changed and not effect.in_flight:
            notes.append(f"{name}: changes recorded logs only, not flights")
    return notes
