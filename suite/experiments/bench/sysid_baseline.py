"""The benchmark `diagnose`: windows of flights, and their fit by `mujoco.sysid`, the baseline.

Windows are short parts of flights of a vehicle to identify. Both sides simulate them with the
measured rotor speeds as input, since a MuJoCo model has no rate loop. The baseline takes finite
differences of rollouts (simulated windows) in MuJoCo's C engine. A rollout starts in the measured
state, because `mujoco.sysid` does not estimate initial states. Residuals are divided by the
measurement noise, so both sides minimise the same error.
"""

from __future__ import annotations

import contextlib
import copy
import io
import os
from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
import mujoco.sysid as sysid
import numpy as np
from scipy.spatial.transform import Rotation

from eval.effects import EFFECTS, all_values
from eval.quadrotor.model import BODY, add_quadrotor, rotor_name
from eval.quadrotor.plant import make_plant
from eval.vehicles.vehicle import Vehicle, with_effects
from suite.diagnose.data.steps import step_s
from suite.diagnose.data.windows import SLICES, FlightWindows, cut, take
from suite.diagnose.estimate.block import NormalEquations
from suite.diagnose.estimate.parameters import ParameterSpace, make_space

STATE_SIZE = 13
"""Size of the state of a free body: position 3, quaternion 4, velocity 3, body rates 3."""
FILL_S = 1e-3
"""Time between the empty rows that fill up a short window [s]."""
REFITTED = ("mass_offset", "com_offset", "inertia_scale")
"""Effects whose parameters are fitted; six of these parameters are identifiable."""


@dataclass(frozen=True)
class Task:
    """Windows, and the parameters that are fitted to them."""

    nominal: Vehicle
    """The nominal vehicle; its parameters are the initial values of both sides."""
    space: ParameterSpace
    """All parameters of the catalogue of effects for that vehicle."""
    indices: tuple[int, ...]
    """Indices of the K fitted parameters in `space`."""
    truth: np.ndarray
    """(K,) values of these parameters for the vehicle that flew."""
    windows: FlightWindows
    """Windows of 1 s, with measured rotor speeds as the input."""

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each fitted parameter, as "effect.parameter component"."""
        entries = [self.space.entries[i] for i in self.indices]
        return tuple(f"{e.effect}.{e.parameter} {e.component or 0}" for e in entries)

    def array(self, field: str) -> np.ndarray:
        """Return a field of `ParameterSpace.entries` for the fitted parameters, (K,)."""
        return self.space.array(field)[list(self.indices)]


def make_task(seed: int, duration_s: float = 10.0) -> Task:
    """Return windows of five MuJoCo flights of `duration_s` [s], with other mass and inertia."""
    from eval.flights.follow import FlightFailed
    from eval.flights.simulate import SENSORS, fly, log_of
    from eval.flights.trajectory import ordinary_flights
    from suite.blind.oracle import nominal_vehicle

    def attempt(number: int) -> Task:
        rng = np.random.default_rng([seed, number])
        truth = with_effects(nominal, _draw_effects(nominal, rng))
        flights = fly(nominal, truth, ordinary_flights(rng, duration_s), sensors.rate_hz)
        logs = [
            log_of(flight, truth, sensors, rng, f"flight {i}") for i, flight in enumerate(flights)
        ]
        windows, _ = cut(logs, nominal, rotor_input=True, integrator="euler")
        assert windows is not None
        return Task(
            nominal, space, indices, make_space(truth).array("start")[list(indices)], windows
        )

    nominal, sensors = nominal_vehicle("bare"), SENSORS["full"]
    space = make_space(nominal)
    indices = tuple(i for i, entry in enumerate(space.entries) if entry.effect in REFITTED)
    number = 0
    while True:
        with contextlib.suppress(FlightFailed):  # a few drawn vehicles are too heavy to fly
            return attempt(number)
        number += 1


def _draw_effects(nominal: Vehicle, rng: np.random.Generator) -> dict[str, Any]:
    """Draw the values of the effects: every parameter differs by its usual size, up or down."""
    neutral, values = all_values(nominal), dict[str, Any]()
    for name in REFITTED:
        fields: dict[str, Any] = {}
        for parameter in EFFECTS[name].parameters:
            size = max(parameter.size, 1)
            shift = rng.uniform(*parameter.typical, size) * rng.choice((-1.0, 1.0), size)
            # Components that no flight can identify do not change.
            shift[list(parameter.unseen)] = 0.0
            value = np.atleast_1d(np.asarray(getattr(neutral[name], parameter.name), float)) + shift
            fields[parameter.name] = tuple(value.tolist()) if parameter.size else float(value[0])
        values[name] = type(neutral[name])(**fields)
    return values


class Problem(NamedTuple):
    """The inputs of `mujoco.sysid`, prepared before the timed fits."""

    task: Task
    """Windows and parameters."""
    params: Any
    """The parameters with their nominal values, a `mujoco.sysid.ParameterDict`."""
    residual: Any
    """Function (values, params) -> residuals divided by their noise."""


def is_installed() -> bool:
    """Return whether all packages of `mujoco.sysid` are installed."""
    return hasattr(sysid, "optimize")


def prepare(task: Task, sigma: np.ndarray) -> Problem:
    """Return the task in the form that `mujoco.sysid` reads.

    `sigma` (19,) is the standard deviation of the noise of each channel. The first 12 are position,
    attitude, velocity and body rates.
    """
    dt = step_s(task.nominal)
    spec = mujoco.MjSpec()
    spec.option.timestep = dt
    add_quadrotor(spec, task.nominal)
    # Never computed: `mujoco.sysid` only needs the size of a measurement.
    spec.add_sensor(name="measured", type=mujoco.mjtSensor.mjSENS_USER, dim=STATE_SIZE)
    base = spec.compile()
    windows = task.windows
    names = [str(w) for w in range(len(windows.flight))]
    sequences = sysid.ModelSequences(
        "quadrotor",
        spec,
        names,
        [_start_state(base, windows, w) for w in range(len(names))],
        [_thrusts(task, w, dt) for w in range(len(names))],
        [_measurements(task, w) for w in range(len(names))],
    )
    scale = 1.0 / np.where(np.isfinite(sigma[:12]), sigma[:12], np.inf)

    def modify_residual(
        params: Any,
        predicted: Any,
        measured: Any,
        model: Any,
        return_pred_all: bool,
        state: np.ndarray,
        **_: Any,
    ) -> tuple[np.ndarray, Any, Any]:
        """Return the simulated states minus the measured ones, divided by the noise."""
        # Row k - 1 of `state` has the time and the state after step k; measured row 0 is the start.
        rows = np.clip(np.rint(measured.times[1:] / dt).astype(int), 1, len(state)) - 1
        errors = _difference(state[rows, 1 : 1 + STATE_SIZE], measured.data[1:])
        return np.where(np.isfinite(errors), errors, 0.0) * scale, measured, measured

    residual = sysid.build_residual_fn(
        models_sequences=[sequences],
        build_model=lambda params, _: _with_parameters(base, task, params.as_vector()),
        modify_residual=modify_residual,
        n_threads=os.cpu_count() or 1,
        resample_true=False,
    )
    params = sysid.ParameterDict()
    start, low, high = (task.array(field) for field in ("start", "low", "high"))
    params.add(sysid.Parameter("numbers", start, low, high))
    return Problem(task, params, residual)


def refit(problem: Problem) -> tuple[np.ndarray, NormalEquations]:
    """Fit the K parameters by `mujoco.sysid`.

    Returns:
        The fitted parameters (K,), and the normal equations at these values, one for each window.
    """
    # `verbose=False` silences `sysid.optimize`, not the optimiser that it calls.
    with contextlib.redirect_stdout(io.StringIO()):
        params, result = sysid.optimize(
            problem.params.copy(),
            problem.residual,
            verbose=False,
            x_scale=problem.task.array("step"),
        )
    values = np.asarray(params.as_vector())
    residuals = problem.residual(values, params)[0]
    count = len(problem.task.windows.flight)
    jacobian = np.asarray(result.jac).reshape(count, -1, len(values))
    residual = np.concatenate(residuals).reshape(count, -1)
    jacobian_t = np.swapaxes(jacobian, 1, 2)
    gradient = -(jacobian_t @ residual[..., None])[..., 0]
    return values, NormalEquations(jacobian_t @ jacobian, gradient, (residual**2).sum(1))


def _with_parameters(base: Any, task: Task, values: np.ndarray) -> Any:
    """Return a copy of the compiled model `base` with the values (K,) of the fitted parameters."""
    theta = task.space.array("start")
    theta[list(task.indices)] = values
    effects = task.space.effects(theta)
    model = copy.copy(base)
    body = model.body(BODY)
    body.mass[:] = task.nominal.mass + effects["mass_offset"].offset
    body.inertia[:] = np.asarray(task.nominal.inertia) * effects["inertia_scale"].scale
    hubs = np.asarray(task.nominal.rotors.position) - effects["com_offset"].offset
    for index, hub in enumerate(hubs):
        model.site(rotor_name(index)).pos[:] = hub
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _start_state(model: Any, windows: Any, w: int) -> np.ndarray:
    """Return the measured state at the start of window `w`, in the form of `mujoco.sysid`."""
    quat, start = np.empty(4), take(windows.start, w)
    mujoco.mju_mat2Quat(quat, start.rot_w.ravel())
    pose, turning = np.concatenate([start.pos_w, quat]), [start.vel_w, start.rate_b]
    return sysid.create_initial_state(model, pose, np.concatenate(turning))


def _thrusts(task: Task, w: int, dt: float) -> Any:
    """Return the thrusts of the rotors in window `w` [N], from the measured rotor speeds."""
    constants = make_plant(task.nominal, dt).constants
    thrust = constants.thrust_coefficient * np.asarray(task.windows.rotor_speed[w]) ** 2
    # The last control is not applied by `mujoco.sysid`: one more row gives all steps.
    thrust = np.concatenate([thrust, thrust[-1:]])
    return sysid.TimeSeries(dt * np.arange(len(thrust)), thrust)


def _measurements(task: Task, w: int) -> Any:
    """Return the measured states of window `w`; missing values are NaN."""
    windows, row = task.windows, take(task.windows.row, w)
    quats = np.empty((len(windows.row_s[w]), 4))
    for quat, rot_w in zip(quats, row.rot_w, strict=True):
        mujoco.mju_mat2Quat(quat, rot_w.ravel())
    values = np.concatenate([row.pos_w, quats, row.vel_w, row.rate_b], axis=1)
    is_seen = np.asarray(windows.valid[w])[:, :12]
    # `seen` has 12 columns and `values` 13: the three angles are a quaternion of four numbers.
    values[~is_seen[:, [0, 1, 2, 3, 3, 3, 3, 6, 7, 8, 9, 10, 11]]] = np.nan
    # A window with fewer rows is filled with empty rows, whose times must still increase.
    times, is_empty = np.array(windows.row_s[w]), ~is_seen.any(axis=1)
    times[is_empty] = times.max() + FILL_S * np.arange(1, is_empty.sum() + 1)
    return sysid.TimeSeries(times, values)


def _difference(simulated: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return simulated minus measured states (N, 12).

    The difference of the attitude is a small rotation in body axes [rad].
    """
    rotation_b = np.full((len(measured), 3), np.nan)
    is_measured = np.isfinite(measured[:, 3:7]).all(axis=1)
    reference, attitude = (
        Rotation.from_quat(rows[is_measured, 3:7], scalar_first=True)
        for rows in (measured, simulated)
    )
    rotation_b[is_measured] = 2.0 * (reference.inv() * attitude).as_quat(canonical=True)[:, :3]
    errors = np.zeros((len(measured), 12))
    errors[:, SLICES["position"]] = simulated[:, :3] - measured[:, :3]
    errors[:, SLICES["attitude"]] = rotation_b
    errors[:, SLICES["velocity"]] = simulated[:, 7:10] - measured[:, 7:10]
    errors[:, SLICES["rates"]] = simulated[:, 10:13] - measured[:, 10:13]
    return errors
