"""Check the hooks of an effect of another program, by calls with a few made-up states.

A hook with a wrong shape, a state of its own or an influence at its neutral value would change
results without an error, even those of vehicles without the effect: a diagnosis simulates all
effects at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from eval.effects.interface import (
    GRAVITY,
    Bound,
    Constants,
    Effect,
    Flow,
    Gust,
    Parameter,
    Sample,
    as_arrays,
    bound_value,
    neutral,
)
from eval.vehicles.vehicle import Controller, Rotors, Vehicle
from tracks.geometry.rotation import exp_rot

ROWS = 5
"""Number of states; it differs from the sizes of vectors (3) and of rotors (4)."""
ARM_M = 0.1
"""Distance of the example's rotors from the body's axes [m]."""
EXAMPLE = Vehicle(
    name="example",
    mass=0.75,
    inertia=(0.0025, 0.0021, 0.0043),
    rotors=Rotors(
        ((ARM_M, -ARM_M, 0.0), (-ARM_M, -ARM_M, 0.0), (-ARM_M, ARM_M, 0.0), (ARM_M, ARM_M, 0.0)),
        (1, -1, 1, -1),
        *(1.6e-6, 2.2e-8, 0.03, 2100.0),
    ),
    controller=Controller((20.0, 20.0, 8.0), 500.0),
)
"""Vehicle for bounds that depend on the vehicle."""


def parameter_problem(effect: Effect) -> str | None:
    """Return which bounds of the parameters contradict each other, or None."""
    for parameter in effect.parameters:
        low, absent, high = (bound_value(bound, EXAMPLE) for bound in _bounds(parameter))
        if not (-np.inf < low < high < np.inf and (low <= absent <= high or parameter.whole)):
            return (
                f"parameter {parameter.name!r} is from {low:g} to {high:g} and neutral at "
                f"{absent:g}; needed is low <= neutral <= high, with low < high, all finite"
            )
        if not set(parameter.unseen) <= set(range(parameter.size)):
            return (
                f"parameter {parameter.name!r} has the unseen components {parameter.unseen}; "
                f"allowed are numbers from 0, below its size ({parameter.size})"
            )
        if not 0.0 < parameter.typical[0] <= parameter.typical[1] < np.inf:
            return (
                f"parameter {parameter.name!r} has the usual sizes {parameter.typical}; give the "
                "smallest and the largest difference from neutral, above 0"
            )
    return None


def hook_problem(effect: Effect) -> str | None:
    """Return what calls of the effect's hooks show to be wrong, or None.

    `late` and `gust` are not called.
    """
    hooks = [name for name in CALLS if getattr(effect, name) is not None]
    if not hooks and effect.late is None:
        return f"without a hook it does nothing; give one of {', '.join(CALLS)}"
    for name in hooks:
        if problem := problem_in_calls(lambda name=name: _problem_of(effect, name)):
            return (
                f"its hook `{name}` {problem}. Hooks get values and states with any number of "
                "leading axes, as NumPy and JAX arrays; see eval/effects/drag.py"
            )
    return None


def problem_in_calls(problem_of: Callable[[], str | None]) -> str | None:
    """Return the result of `problem_of`, which calls code of another program, or its error."""
    import jax  # imported here, because only code of other programs needs it

    try:
        # The first use of an effect or a sensor may be inside a function that JAX traces.
        with np.errstate(all="ignore"), jax.ensure_compile_time_eval():
            return problem_of()
    except Exception as error:  # such code may raise anything
        return f"fails with {type(error).__name__}: {(str(error) or '?').splitlines()[0]}"


def _problem_of(effect: Effect, name: str) -> str | None:
    """Return what is wrong with one hook, or None."""
    import jax

    hook = getattr(effect, name)
    tangent = jax.jit(lambda *given: jax.jvp(hook, given, jax.tree.map(jax.numpy.ones_like, given)))
    for values, is_neutral in ((neutral(effect, EXAMPLE), True), (_usual(effect), False)):
        one = as_arrays(values)
        many = type(one)(*(np.tile(value, (ROWS, *[1] * value.ndim)) for value in one))
        for moving in (0.0, 1.0):
            given, absent = CALLS[name](_flow(effect, one, moving))
            for array in jax.tree.leaves((one, many, given)):
                array.setflags(write=False)  # a hook that writes into its input raises
            first = hook(one, *given)
            in_jax, slope = tangent(one, *given)
            results = {
                "": first,
                " in a second call": hook(one, *given),
                " with values for each row": hook(many, *given),
                " in JAX": in_jax,
            }
            for how, result in results.items():
                if jax.tree.structure(result) != jax.tree.structure(absent):
                    return f"returns a {type(result).__name__}, not a {type(absent).__name__}"
                leaves = map(jax.tree.leaves, (result, first, absent))
                for got, plain, same in zip(*leaves, strict=True):
                    # What depends on the values only has no axis of rows.
                    if np.shape(got) not in (same.shape, same.shape[1:]):
                        return f"returns the shape {np.shape(got)}{how}, must be {same.shape}"
                    if not np.isfinite(got).all():
                        return f"returns numbers that are not finite{how}, for {values}"
                    if not np.allclose(got, plain, 1e-3, 1e-4 * np.abs(plain).max()):
                        return f"returns other numbers{how}, for {values}"
                    if is_neutral and not np.allclose(plain, same, 1e-9, 1e-12):
                        return f"changes the flight at the neutral values {values}"
            if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope)):
                return f"has a derivative that is not finite, for {values}"
    return None


def _usual(effect: Effect) -> Any:
    """Return values of the smallest usual size."""
    values = []
    for parameter in effect.parameters:
        low, absent, high = (bound_value(b, EXAMPLE) for b in _bounds(parameter))
        size = parameter.typical[0] * parameter.signs[0]
        number = min(max(size if parameter.whole else absent + size, low), high)
        values.append((number,) * parameter.size if parameter.size else number)
    return effect.values(*values)


def _bounds(parameter: Parameter) -> tuple[Bound, Bound, Bound]:
    return parameter.low, parameter.neutral, parameter.high


def _flow(effect: Effect, values: Any, moving: float) -> Flow:
    """Return states with a leading axis of `ROWS`: at rest (`moving` is 0), or moving (1)."""
    ramp = moving * np.linspace(0.5, 1.5, ROWS)

    def each(value: Any) -> np.ndarray:
        value = np.asarray(value, float)
        return np.tile(value, (ROWS, *[1] * value.ndim))

    rotors = EXAMPLE.rotors
    constants = Constants(
        each(EXAMPLE.mass),
        each(EXAMPLE.inertia),
        each([0.0, 0.0, -GRAVITY]),
        each(np.zeros(3)),
        each(rotors.position),
        each(np.full(4, rotors.thrust_coefficient)),
        each(np.full(4, rotors.torque_coefficient)),
        each([0.0, 0.0, 1.0]),
        each(rotors.time_constant),
        each(EXAMPLE.controller.rate_gain),
        each(0.0),
    )
    flow = Flow(
        constants,
        pos_w=ramp[:, None] * [1.0, -2.0, 0.5] + [0.0, 0.0, 1.0],
        rot_w=exp_rot(ramp[:, None] * [0.2, -0.3, 0.5]),
        air_vel_b=ramp[:, None] * [3.0, -2.0, 1.0],
        rate_b=ramp[:, None] * [1.0, 2.0, -0.5],
        rotor_speed=each([1100.0, 1050.0, 1080.0, 1120.0]),
        spin=np.array(rotors.spin, float),
        time_s=10.0 * ramp,
        voltage_drop=None,
        rotor_acc=ramp[:, None] * [50.0, -40.0, 30.0, -20.0],
        dt=np.asarray(0.002),
    )
    return flow._replace(memory=effect.start(values, flow)) if effect.start else flow


def _of_wind(flow: Flow) -> Call:
    still, noise = np.zeros((ROWS, 3)), np.tile([0.5, -1.0, 0.2], (ROWS, 1))
    return (Gust(still, flow.air_vel_b, noise, np.asarray(flow.dt)),), still


def _of_sample(flow: Flow) -> Call:
    acc_b = np.tile([0.0, 0.0, GRAVITY], (ROWS, 1))
    sample = Sample(flow.pos_w, flow.rot_w, flow.air_vel_b, flow.rate_b, acc_b)
    return (sample,), sample


def _of_thrust(flow: Flow) -> Call:
    thrust = flow.constants.thrust_coefficient * flow.rotor_speed**2
    return (flow, thrust), thrust


Call = tuple[tuple[Any, ...], Any]
"""The arguments of a hook after the values, and what it returns where the effect is absent."""
CALLS: dict[str, Callable[[Flow], Call]] = {
    "constants": lambda flow: ((flow.constants,), flow.constants),
    "wind": _of_wind,
    "thrust": _of_thrust,
    "force": lambda flow: ((flow,), np.zeros((ROWS, 3))),
    "torque": lambda flow: ((flow,), np.zeros((ROWS, 3))),
    "measure": _of_sample,
}
"""Hook -> its arguments, made from a `Flow`, and the result that changes nothing."""
