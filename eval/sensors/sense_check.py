"""Check a sensor model of another program, by calls with a few made-up views.

The judge calls a model with NumPy arrays, the trainer with JAX arrays. A wrong shape or a state
outside of its memory would change results without an error.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from eval.effects.hook_check import ROWS, problem_in_calls
from eval.effects.interface import as_arrays
from eval.sensors.interface import STAGES, Moment, Parameter, Sensor, blank_draws, draw
from policies.observation import View
from tracks.geometry.camera import Camera
from tracks.geometry.rotation import exp_rot

CAMERA = Camera(width=8, height=6)
"""Camera of the views."""
DT_S = 0.1
"""Time between the views [s]."""
HOOKS = ("sense", "ages", "estimate", "measure")
"""The functions of which a model needs at least one."""


def sensor_problem(sensor: Sensor) -> str | None:
    """Return what is wrong with the bounds or with `start` and `sense`, or None."""
    if sensor.stage not in STAGES:
        return f"its stage is {sensor.stage!r}; must be one of {', '.join(STAGES)}"
    if not any(getattr(sensor, hook) for hook in HOOKS):
        return f"without a function it does nothing; give one of {', '.join(HOOKS)}"
    for parameter in sensor.parameters:
        low, high = parameter.low, parameter.high
        if not -np.inf < low <= parameter.neutral <= high < np.inf or low == high:
            return (
                f"parameter {parameter.name!r} is from {low:g} to {high:g} and neutral at "
                f"{parameter.neutral:g}; needed is low <= neutral <= high, low < high, all finite"
            )
    if not (sense := sensor.sense):
        return None
    if problem := problem_in_calls(lambda: _problem_of(sensor, sense)):
        return (
            f"`start` or `sense` {problem}. They get a row for each drone, as NumPy and JAX "
            "arrays; see eval/sensors/depth_cameras.py"
        )
    return None


def _problem_of(sensor: Sensor, sense: Callable[..., tuple[View, Any]]) -> str | None:
    """Return what is wrong with the results of `start` and `sense`, or None."""
    import jax

    def seen_by(values: Any, trial: Any, *views_and_draws: tuple[View, Any]) -> tuple[Any, list]:
        """Return the memory at the start, and what the model shows of each view."""
        (first, _), *_ = views_and_draws
        memory = start = (
            sensor.start(values, Moment(first, trial, DT_S, CAMERA)) if sensor.start else ()
        )
        shown = []
        for truth, draws in views_and_draws:
            seen, memory = sense(values, memory, truth, Moment(truth, draws, DT_S, CAMERA))
            shown.append((seen, memory))
        return start, shown

    rng = np.random.default_rng(0)
    trial, first, second = (
        blank_draws(needs, ROWS, CAMERA)
        for needs in (sensor.trial, sensor.observation, sensor.observation)
    )
    for draws in (trial, first, second):
        for row in range(ROWS):
            draw(draws, row, rng)
    views = _view(0.0), _view(0.5)
    in_jax = jax.jit(seen_by)
    for size in (0, 1):
        values = as_arrays(sensor.values(*(_value(p, sensor, size) for p in sensor.parameters)))
        given = values, trial, (views[0], first), (views[1], second)
        for array in jax.tree.leaves(given):
            array.setflags(write=False)  # a model that writes into its input raises
        start, shown = seen_by(*given)
        many = type(values)(*(np.full(ROWS, value) for value in values))
        results = {
            "": shown,
            " in a second call": seen_by(*given)[1],
            " with values for each row": seen_by(many, *given[1:])[1],
            " in JAX": in_jax(*given)[1],
        }
        for how, result in results.items():
            for (seen, memory), (plain, _), truth in zip(result, shown, views, strict=True):
                if not isinstance(seen, View):
                    return f"returns a {type(seen).__name__}, not a View"
                if jax.tree.map(np.shape, memory) != jax.tree.map(np.shape, start):
                    return f"returns a memory of another form than at the start{how}"
                for field in View._fields:
                    got, same = getattr(seen, field), getattr(truth, field)
                    if np.shape(got) != same.shape:
                        return f"returns {field} of shape {np.shape(got)}{how}, not {same.shape}"
                    if not np.isfinite(got).all():
                        return f"returns a {field} that is not finite{how}, for {values}"
                    if not np.allclose(got, getattr(plain, field), 1e-3, 1e-3):
                        return f"returns another {field}{how}"
                    if not size and not np.allclose(got, same, 1e-4, 1e-4):
                        return f"changes {field}{how} at the neutral values, which give no errors"
    return None


def _value(parameter: Parameter, sensor: Sensor, size: int) -> float:
    """Return the neutral value of what grows with the errors, or the smallest usual one."""
    is_neutral = not size and parameter.name in sensor.grows
    return parameter.neutral if is_neutral else parameter.typical[0]


def _view(time_s: float) -> View:
    """Return the true views of `ROWS` drones in flight."""
    row = np.arange(ROWS, dtype=float)[:, None]
    gate_w = np.tile([6.0, 0.5, 1.0], (ROWS, 1))
    ahead = np.tile([1.0, 0.0, 0.0], (ROWS, 1))
    return View(
        pos_w=np.array([2.0, 0.3, 0.1]) * time_s + 0.1 * row + [0.0, 0.0, 1.0],
        rot_w=exp_rot(np.array([0.1, 0.2, 0.3]) * time_s + 0.02 * row),
        vel_w=np.array([2.0, 0.3, 0.1]) + 0.1 * row,
        gate_w=gate_w,
        second_w=gate_w + [4.0, 1.0, 0.0],
        axis_w=ahead,
        second_axis_w=ahead.copy(),
        depth_m=np.linspace(2.0, 9.0, ROWS * 48).reshape(ROWS, 6, 8),
        gate_number=np.zeros(ROWS, int),
    )
