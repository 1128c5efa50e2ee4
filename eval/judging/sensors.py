"""Apply sensor models (errors of state and image) and the state estimator in the judge.

They change only the policy's observation; the autopilot, its commanded heading and the scoring use
the true state. All random numbers come from the trial's seed, model by model and in a fixed order,
so a trial's outcome depends on the trial only.

With an estimator, a Kalman filter for each trial gives the policy its state. After each physics
step an IMU measurement is simulated. Gate corners are detected at the camera's frame rate and reach
the filter after a delay.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from eval import sensors
from eval.effects.interface import GRAVITY, as_arrays
from eval.sensors import SENSORS
from eval.sensors.filter.kalman import (
    SIZE,
    Corners,
    Delayed,
    FilterState,
    ImuNoise,
    current_state,
    project,
    start,
    start_delayed,
    step,
    update_gate,
)
from eval.sensors.gate_filter import GateFilter
from eval.sensors.interface import Inertial, blank_model_draws, draw, markov_step, rotation_since
from eval.sensors.sensors_file import SensorSet
from eval.worlds.slots import SENSED, generator_of
from eval.worlds.trial import TrialSpec
from policies.observation import View
from tracks.common.masks import make_contiguous, select, take
from tracks.geometry.camera import Camera
from tracks.geometry.rotation import exp_rot, to_local, to_world
from tracks.geometry.scene import Gates

NEAR_M = 0.2
"""Gate corners nearer to the camera than this are not detected [m]."""


class Sensors:
    """The sensors of N slots, with the errors of the trial that flies in each slot."""

    def __init__(self, wanted: SensorSet, slots: int, rate_hz: float, camera: Camera) -> None:
        """Make the sensors of `slots` trials at once, observed at `rate_hz` [Hz]."""
        self._models = sensors.view_models(wanted.models)
        self._dt_s, self._camera = 1 / rate_hz, camera
        used = (SENSORS[name] for name in self._models)
        self._trial, self._draws = blank_model_draws(used, slots, camera)
        unused = np.random.default_rng(0)
        self._generators = {name: [unused] * slots for name in self._models}
        self._memory: dict[str, Any] | None = None

    def start(self, slot: int, trial: TrialSpec) -> None:
        """Begin `trial` in `slot`."""
        for name, generators in self._generators.items():
            generators[slot] = generator_of(trial, SENSED, name)
            draw(self._trial[name], slot, generators[slot])

    def see(self, truth: View, fresh: np.ndarray, flying: np.ndarray) -> View:
        """Return the view with sensor errors; call it once for each observation.

        The true views are (N, ...), with the number of the next gate. In `fresh` slots (N,) bool a
        trial begins. Slots that are not `flying` (N,) bool are returned unchanged.
        """
        rows = np.flatnonzero(flying)
        for name, generators in self._generators.items():
            for slot in rows.tolist():
                draw(self._draws[name], slot, generators[slot])
        if not len(rows):
            return truth
        # Views of empty slots are undefined; they are replaced by that of a flying slot.
        filled = take(truth, np.where(flying, np.arange(len(flying)), rows[0]))
        models, timing_and_camera = self._models, (self._dt_s, self._camera)
        memory = self._memory
        if memory is None or fresh.any():
            started = sensors.start(models, filled, self._trial, *timing_and_camera)
            memory = started if memory is None else select(fresh, started, memory)
        seen, self._memory = sensors.sense(models, memory, filled, self._draws, *timing_and_camera)
        return select(flying, seen, truth)


class Pending(NamedTuple):
    """A camera frame of each slot, with K corners, that has not reached the filter yet."""

    image: np.ndarray
    """(N, K, 2) image coordinates of the corners, as tangents of angles."""
    seen: np.ndarray
    """(N, K) bool, whether a corner was detected."""
    due: np.ndarray
    """(N,) number of the physics step at which the frame reaches the filter; -1 for no frame."""


class Filtered:
    """The Kalman filters of N slots, with their simulated IMU and corner detections."""

    def __init__(
        self, wanted: SensorSet, slots: int, dt: float, camera: Camera, corners: int
    ) -> None:
        """Make the filters.

        One of the sensors is the estimator. `dt` is the length of a physics step, and the time
        between IMU measurements [s]. Corners are detected with the camera's pitch and field of
        view; a track has at most `corners` of them.

        Raises:
            ValueError: if the sensors file also delays the state, or has more frames than physics
                steps.
        """
        if wanted.ages.state_s:
            raise ValueError(
                f"sensors {wanted.name!r}: delay.state is {wanted.ages.state_s:g} s, but the "
                "estimator has a delay itself: leave delay.state out"
            )
        settings: GateFilter = wanted.estimator
        if settings.rate * dt > 1 + 1e-9:
            raise ValueError(
                f"sensors {wanted.name!r}: gate_filter.rate is {settings.rate:g} Hz; allowed "
                f"is up to the {1 / dt:g} Hz of the physics (the vehicle's controller.frequency): "
                "lower the rate"
            )
        self._settings, self._dt, self._camera = settings, dt, camera
        sigmas = settings.position, settings.velocity, settings.attitude
        sigmas = (*sigmas, settings.acc_bias, settings.gyro_bias)
        self._start_sigma = np.repeat(np.array(sigmas, float), 3)  # in the order of the error state
        self._imu = {
            name: as_arrays(values)
            for name, values in wanted.models.items()
            if SENSORS[name].measure
        }
        used = (SENSORS[name] for name in self._imu)
        self._trial, self._sample = blank_model_draws(used, slots, camera)
        self._delay_steps = round(settings.delay / dt)
        self._period = 1.0 / (settings.rate * dt)
        self._half_view = np.tan(np.deg2rad(np.asarray(camera.fov_deg)) / 2.0)
        self._sigma = settings.pixel * 2.0 * self._half_view[0] / settings.width
        pitch = np.deg2rad(camera.pitch_deg)
        cos, sin = np.cos(pitch), np.sin(pitch)
        self._camera_b = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
        unused = np.random.default_rng(0)
        self._frame_rngs, self._imu_rngs = [unused] * slots, [unused] * slots
        self._corner_w = np.zeros((slots, corners, 3))
        self._exists = np.zeros((slots, corners), bool)  # tracks may have fewer corners
        self._steps, self._frame = np.zeros(slots, int), np.zeros(slots, int)
        self._lost = np.zeros(slots, bool)
        self._pending = [
            Pending(
                np.zeros((slots, corners, 2)), np.zeros((slots, corners), bool), np.full(slots, -1)
            )
            for _ in range(math.ceil(self._delay_steps / self._period) + 1)
        ]
        self._error = np.zeros((slots, SIZE))
        self._memory: dict[str, Any] | None = None
        self._truth: View | None = None
        self.filters: Delayed | None = None
        """The filters of all slots; values in empty slots are undefined."""

    def start(self, slot: int, trial: TrialSpec, gates: Gates) -> None:
        """Start `trial` in `slot`, on a track with these gates."""
        rng = generator_of(trial, SENSED, "gate_filter")
        self._error[slot] = rng.standard_normal(SIZE) * self._start_sigma
        self._lost[slot] = rng.random() < self._settings.dropout
        self._frame_rngs[slot] = rng
        self._imu_rngs[slot] = generator_of(trial, SENSED, "imu")
        for numbers in self._trial.values():
            draw(numbers, slot, self._imu_rngs[slot])
        corner_w = corners_of(gates)
        self._exists[slot] = np.arange(self._exists.shape[1]) < len(corner_w)
        self._corner_w[slot, : len(corner_w)] = corner_w
        self._steps[slot] = self._frame[slot] = 0
        for pending in self._pending:
            pending.due[slot] = -1

    def see(self, view: View, truth: View, fresh: np.ndarray, flying: np.ndarray) -> View:
        """Return `view` with position, velocity and attitude replaced by the estimates.

        `view` (N, ...) is that after the other sensor models. The depth of `truth` is not used. In
        `fresh` slots (N,) bool a trial starts now, those `flying` (N,) bool are in flight.
        """
        starting = fresh & flying
        if starting.any():
            self._begin(truth, starting)
            self._detect(starting)
        assert self.filters is not None
        state = current_state(self.filters)
        estimate = View(state.pos_w, state.rot_w, state.vel_w, *view[3:])
        return select(flying, estimate, view)

    def _begin(self, truth: View, starting: np.ndarray) -> None:
        """Start the filters and the IMU's state in the slots `starting`."""
        truth = truth._replace(depth_m=None, gate_number=None)
        pose = View(*truth[:3], *(np.zeros(len(starting)),) * 4)
        self._truth = pose if self._truth is None else select(starting, pose, self._truth)
        error, sigma = self._error, self._start_sigma
        # Truth = estimate + error; the attitude error is in the body axes of the estimate.
        initial = start(
            pose.pos_w - error[:, :3],
            pose.vel_w - error[:, 3:6],
            np.matmul(pose.rot_w, exp_rot(-error[:, 6:9])),
            sigma,
        )
        started = start_delayed(initial, self._delay_steps)
        filters = started if self.filters is None else select(starting, started, self.filters)
        self.filters = make_contiguous(filters)
        memory = sensors.start(self._imu, truth, self._trial, self._dt, self._camera)
        self._memory = memory if self._memory is None else select(starting, memory, self._memory)

    def follow(self, view: View, flew: np.ndarray) -> None:
        """Advance the filters by one physics step, to the true `view` after it.

        Only the slots that `flew` (N,) bool made the step.
        """
        assert self._truth is not None and self.filters is not None and self._memory is not None
        truth_before, dt = self._truth, np.full(len(flew), self._dt)
        with np.errstate(invalid="ignore", over="ignore"):  # values in empty slots are undefined
            sample = inertial(truth_before, view, self._dt)
            for name, values in self._imu.items():
                measure = SENSORS[name].measure
                assert measure is not None
                for slot in np.flatnonzero(flew).tolist():
                    draw(self._sample[name], slot, self._imu_rngs[slot])
                memory = self._memory[name]
                sample, memory = measure(values, memory, sample, self._sample[name], self._dt)
                self._memory[name] = select(flew, memory, self._memory[name])
            imu = sample.rate_b, sample.acc_b, dt, flew
            noise = ImuNoise(*self._settings[-4:])
            self.filters = make_contiguous(step(self.filters, *imu, noise))
        truth_now = View(view.pos_w, view.rot_w, view.vel_w, *truth_before[3:])
        self._truth = select(flew, truth_now, truth_before)
        self._steps += flew
        self._arrive(flew)
        self._detect(flew & (self._steps == np.rint(self._frame * self._period)))

    def _detect(self, due: np.ndarray) -> None:
        """Simulate a camera frame in the slots `due`: project corners, add noise, store them."""
        rows, settings = np.flatnonzero(due), self._settings
        if not len(rows):
            return
        assert self._truth is not None
        truth, corner_w = take(self._truth[:3], rows), self._corner_w[rows]
        with np.errstate(divide="ignore", invalid="ignore"):
            image, forward = project(truth[0], truth[1], self._camera_b, corner_w)
        inside = (np.abs(image) <= self._half_view).all(-1)
        seen = self._exists[rows] & inside & (forward > NEAR_M) & (forward < settings.range)
        chance, noise = np.zeros(len(rows)), np.zeros(image.shape)
        for k, slot in enumerate(rows.tolist()):
            rng, count = self._frame_rngs[slot], int(self._exists[slot].sum())
            chance[k], noise[k, :count] = rng.random(), rng.standard_normal((count, 2))
        share, length_s = np.asarray(settings.dropout), np.asarray(settings.dropout_length)
        lost = markov_step(self._lost[rows], chance, share, length_s, 1.0 / settings.rate)
        self._lost[rows] = lost
        # Frames are stored in turn in the entries of `_pending`, a ring buffer.
        entry = self._frame[rows] % len(self._pending)
        for number in np.unique(entry).tolist():
            chosen = entry == number
            pending, to = self._pending[number], rows[chosen]
            pending.image[to] = (image + self._sigma * noise)[chosen]
            pending.seen[to] = (seen & ~lost[:, None])[chosen]
            pending.due[to] = self._steps[to] + self._delay_steps
        self._frame[rows] += 1
        if not self._delay_steps:
            self._arrive(due)

    def _arrive(self, flew: np.ndarray) -> None:
        """Update the filters with the frames whose delay has passed."""
        assert self.filters is not None
        for pending in self._pending:
            rows = np.flatnonzero(flew & (pending.due == self._steps) & pending.seen.any(1))
            if not len(rows):
                continue
            corners = Corners(pending.image[rows], self._corner_w[rows], pending.seen[rows])
            state = take(self.filters.state, rows)
            updated = update_gate(state, corners, self._sigma**2, self._camera_b)
            parts = zip(self.filters.state, updated, strict=True)
            state = FilterState(*(_with_rows(array, rows, new) for array, new in parts))
            self.filters = self.filters._replace(state=state)
            pending.due[rows] = -1


def _with_rows(array: np.ndarray, rows: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Return a copy of `array` with `new` at `rows`; other states may share the original."""
    changed = array.copy()
    changed[rows] = new
    return changed


def single_steps(steps: np.ndarray) -> list[np.ndarray]:
    """Split numbers of steps (N,) into a list of single steps.

    Each entry (N,) is 1 in slots that have steps left, else 0.
    """
    return [(steps > done).astype(int) for done in range(int(steps.max(initial=0)))]


def corners_of(gates: Gates) -> np.ndarray:
    """Return the corners (K, 3) of all gate openings in world axes, without repetitions [m]."""
    opening = np.asarray(gates.opening_g)
    corner_g = np.concatenate([np.zeros((*opening.shape[:2], 1)), opening], axis=-1)
    corner_w = gates.center_w[:, None] + to_world(gates.rot_w[:, None], corner_g)
    # An opening with fewer corners than others is padded by repeating its last corner.
    repeated = np.zeros(opening.shape[:2], bool)
    repeated[:, 1:] = (opening[:, 1:] == opening[:, :-1]).all(-1)
    return corner_w[~repeated]


def inertial(before: View, after: View, dt: float) -> Inertial:
    """Return the measurements of an ideal IMU: means over a step, in body axes at mid-step."""
    # The axis of the rotation times the sine of its angle, and from it the rotation vector.
    sine_b = rotation_since(after.rot_w, before.rot_w)
    sine = np.sqrt((sine_b**2).sum(-1))[..., None]
    turn_b = sine_b * np.where(sine > 1e-9, np.arcsin(np.minimum(sine, 1.0)) / (sine + 1e-300), 1.0)
    acc_w = (after.vel_w - before.vel_w) / dt + [0.0, 0.0, GRAVITY]
    middle_w = np.matmul(before.rot_w, exp_rot(0.5 * turn_b))
    return Inertial(turn_b / dt, to_local(middle_w, acc_w))
