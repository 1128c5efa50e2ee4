"""What a policy is shown instead of the truth: noisy depth, misplaced gates, an estimated state.

The noise is in the policy's observation alone: the autopilot below it, its heading included, and
the judge see the truth. Everything random is drawn from the trial's own seed, in an order that
nothing else can change, so a trial's outcome stays set by the trial; two strengths of one noise
have the same draws.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from eval.worlds.slots import GATES, PIXELS, STATE, generator_of
from eval.worlds.trial import TrialSpec
from policies.observation import View
from tracks.geometry.rotation import exp_rot, to_world

NEAREST_M = 1e-3
"""Depths below this count as this where they are inverted [m]."""


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of what is added to the policy's observation; all 0: the truth."""

    inverse_depth: float = 0.0
    """Of every pixel's inverse depth, white; a stereo camera's noise has this form [1/m]."""
    gate_m: float = 0.0
    """Of each gate's position, per axis, the same for the whole trial: an error of the map [m]."""
    pos_m: float = 0.0
    """Of the estimated position, per axis [m]."""
    vel: float = 0.0
    """Of the estimated velocity, per axis [m/s]."""
    attitude_rad: float = 0.0
    """Of the estimated attitude, about each body axis [rad]."""
    correlation_s: float = 0.5
    """Time over which errors of the estimated state change; 0: they are white [s]."""
    state_age_s: float = 0.0
    """How old the state is at the decision (`eval/judging/ages.py`) [s]."""
    image_age_s: float = 0.0
    """How old the image is at the decision [s]."""
    age_jitter: float = 0.0
    """Both ages are means then: each decision's is drawn evenly from up to this share less to as
    much more, that of the state and that of the image apart [1]."""
    image_loss: float = 0.0
    """Share of the images that do not come; the one before is seen again, with
    noise of its own where images have some [1]."""

    @property
    def is_late(self) -> bool:
        """Say whether anything is old or lost."""
        return bool(self.state_age_s or self.image_age_s or self.image_loss)

    @property
    def is_none(self) -> bool:
        """Say whether nothing is added; ages and losses add nothing."""
        return not (self.inverse_depth or self.gate_m or self.of_state)

    @property
    def of_state(self) -> bool:
        """Say whether the estimated state has errors."""
        return bool(self.pos_m or self.vel or self.attitude_rad)


_SHARES = ("image_loss", "age_jitter")


def check_noise(noise: SensorNoise) -> None:
    """Refuse noise that cannot be.

    Raises:
        ValueError: naming the field, its value and what is allowed.
    """
    for field in fields(noise):
        value = getattr(noise, field.name)
        if field.name in _SHARES and value > 1:
            raise ValueError(f"sensor noise {field.name} is {value!r}; allowed are shares, 0 to 1")
        if not (math.isfinite(value) and value >= 0):
            raise ValueError(
                f"sensor noise {field.name} is {value!r}; allowed are finite numbers, 0 or more"
            )


class Sensors:
    """The sensors of N slots, with the errors of the trial that flies in each."""

    def __init__(self, noise: SensorNoise, slots: int, rate_hz: float, range_m: float) -> None:
        """Make the sensors.

        Args:
            noise: how strong.
            slots: how many trials fly at once.
            rate_hz: observations a second [Hz].
            range_m: of the camera; depths are clipped to it [m].

        Raises:
            ValueError: for noise that cannot be.
        """
        check_noise(noise)
        self._noise, self._range_m = noise, range_m
        self._kept = 0.0
        if noise.correlation_s:
            self._kept = math.exp(-1.0 / (rate_hz * noise.correlation_s))
        nobody = np.random.default_rng(0)
        self._pixels, self._walk = [nobody] * slots, [nobody] * slots
        self._shift_w = [np.zeros((1, 3))] * slots
        self._error = np.zeros((slots, 9))
        self._is_new = np.ones(slots, bool)

    def start(self, slot: int, trial: TrialSpec, gates: int) -> None:
        """Begin `trial`, on a track of `gates` gates, in `slot`."""
        draws = generator_of(trial, GATES).standard_normal((gates, 3))
        self._shift_w[slot] = self._noise.gate_m * draws
        self._pixels[slot] = generator_of(trial, PIXELS)
        self._walk[slot] = generator_of(trial, STATE)
        self._is_new[slot] = True

    def misplace(self, truth: View, gate: np.ndarray, wanted: np.ndarray) -> View:
        """Return `truth` with the gates where the trial's map has them.

        Args:
            truth: what there is to see in each slot.
            gate: (N,) number of each slot's next gate, at the time of `truth`.
            wanted: (N,) bool, the slots that fly; the others' rows stay as they are.
        """
        if not self._noise.gate_m:
            return truth
        gate_w, second_w = np.array(truth.gate_w, float), np.array(truth.second_w, float)
        for slot in np.flatnonzero(wanted).tolist():
            shift, last = self._shift_w[slot], len(self._shift_w[slot]) - 1
            gate_w[slot] += shift[min(int(gate[slot]), last)]
            second_w[slot] += shift[min(int(gate[slot]) + 1, last)]
        return truth._replace(gate_w=gate_w, second_w=second_w)

    def see(self, mapped: View, wanted: np.ndarray) -> View:
        """Return what the sensors show, whose errors walk on; call it once an observation.

        Args:
            mapped: what there is to see in each slot, with gates as the map has them (`misplace`).
            wanted: (N,) bool, the slots that fly; the others' rows stay as they are.
        """
        noise, slots = self._noise, np.flatnonzero(wanted).tolist()
        seen = mapped
        if noise.inverse_depth:
            seen = seen._replace(depth_m=self._images(mapped.depth_m, slots))
        if noise.of_state:
            self._estimate(slots)
            error = np.where(wanted[:, None], self._error, 0.0)
            turn = exp_rot(noise.attitude_rad * error[:, 6:])
            axes = [to_world(mapped.rot_w, turn[..., axis]) for axis in range(3)]
            seen = seen._replace(
                pos_w=mapped.pos_w + noise.pos_m * error[:, :3],
                vel_w=mapped.vel_w + noise.vel * error[:, 3:6],
                rot_w=np.stack(axes, axis=-1),
            )
        return seen

    def _images(self, depth_m: np.ndarray, slots: list[int]) -> np.ndarray:
        noisy = np.array(depth_m, float)
        for slot in slots:
            draws = self._pixels[slot].standard_normal(noisy.shape[1:])
            inverse = 1.0 / np.maximum(noisy[slot], NEAREST_M) + self._noise.inverse_depth * draws
            noisy[slot] = 1.0 / np.maximum(inverse, 1.0 / self._range_m)
        return noisy

    def _estimate(self, slots: list[int]) -> None:
        """Let the unit errors of the estimated states change by one observation."""
        for slot in slots:
            draws = self._walk[slot].standard_normal(9)
            if self._is_new[slot]:
                self._error[slot], self._is_new[slot] = draws, False
            else:
                fresh = math.sqrt(1.0 - self._kept**2)
                self._error[slot] = self._kept * self._error[slot] + fresh * draws
