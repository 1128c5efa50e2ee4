"""The `Sensor` dataclass: its parameters, and the functions that change a drone's observations.

A model is written once, for rows of NumPy or JAX arrays. The judge calls it with draws from each
trial's own seed, the trainer with draws from JAX keys. Random numbers are passed in as arrays whose
number does not depend on the magnitude, so that two magnitudes of one model use the same draws.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from eval.effects.interface import Parameter as Parameter
from policies.observation import View
from tracks.geometry.camera import Camera
from tracks.geometry.scene import Array

Values = Any  # the model's own NamedTuple of floats or arrays (...,)
Memory = Any  # arrays (..., K), or nested tuples and dicts of them


STAGES = ("state", "gates", "depth", "imu")
"""What a model changes: estimated state, gates, depth image, inertial sensor."""


class Needs(NamedTuple):
    """Numbers of random draws of a model."""

    normal: int = 0
    """Standard normal numbers."""
    uniform: int = 0
    """Uniform numbers from 0 to 1."""
    grain: int = 0
    """Images of standard normal numbers."""
    chance: int = 0
    """Images of uniform numbers from 0 to 1."""


class Draws(NamedTuple):
    """Random numbers of N rows, with the numbers of `Needs`."""

    normal: Array
    """(..., K)."""
    uniform: Array
    """(..., K)."""
    grain: Array
    """(..., K, H, W)."""
    chance: Array
    """(..., K, H, W)."""


class Moment(NamedTuple):
    """Inputs of a model for one observation, besides the output of the models before it."""

    truth: View
    """The true view, at the time of the observation."""
    draws: Draws
    """Of this observation; for `start`, of the trial."""
    dt_s: Any
    """Time since the observation before [s]."""
    camera: Camera
    """The policy's."""


class Ages(NamedTuple):
    """Ages of an observation at a decision."""

    state_s: float = 0.0
    """Mean age of the state [s]."""
    image_s: float = 0.0
    """Mean age of the image [s]."""
    jitter: float = 0.0
    """Largest relative deviation of a decision's age from the mean, uniformly distributed [1]."""


class Inertial(NamedTuple):
    """A sample of an inertial measurement unit in body axes."""

    rate_b: Array
    """(..., 3) [rad/s]."""
    acc_b: Array
    """(..., 3) specific force [m/s^2]."""


@dataclass(frozen=True)
class Sensor:
    """A sensor or estimator model; unused functions are None."""

    name: str
    """The `kind` of its table in a sensors file."""
    stage: str
    """Its table in a sensors file, one of `STAGES`."""
    summary: str
    """One sentence for people."""
    equation: str
    """The observation as a function of the truth."""
    source: str
    """Publications of the equation and the usual sizes."""
    values: type
    """NamedTuple class with a field for each parameter, in order."""
    parameters: tuple[Parameter, ...]
    """All plain numbers; the neutral values give no errors."""
    grows: tuple[str, ...]
    """Parameters that scale with the magnitude; the others are constant."""
    trial: Needs = Needs()
    """Draws at the start of a trial."""
    observation: Needs = Needs()
    """Draws of an observation; of an inertial model, of a sample."""
    start: Callable[[Values, Moment], Memory] | None = None
    """Returns the model's state at the first observation, from the trial's draws."""
    sense: Callable[[Values, Memory, View, Moment], tuple[View, Memory]] | None = None
    """Takes the view of the models before it; returns the changed view, and the state."""
    ages: Callable[[Values], Ages] | None = None
    """For a delay: the ages of the observation."""
    estimate: Callable[[Values], Any] | None = None
    """For an estimator in the loop: its `eval.sensors.filter.kalman.FilterSettings`."""
    measure: Callable[[Values, Memory, Inertial, Draws, Any], tuple[Inertial, Memory]] | None = None
    """For an inertial sensor: (values, state, truth, draws, dt_s) -> measurement, state."""


def column(value: Array) -> Array:
    """Return numbers (...,) as (..., 1), to multiply vectors."""
    return value[..., None]


def over_image(value: Array) -> Array:
    """Return numbers (...,) as (..., 1, 1), to multiply images."""
    return value[..., None, None]


def absent(values: Values, moment: Moment) -> Array:
    """Return the start of an intermittent fault with one uniform draw: absent (...,)."""
    del values
    return moment.draws.uniform[..., 0] < 0.0


def sticky(on: Array, chance: Array, share: Array, length_s: Array, dt_s: Any) -> Array:
    """Return whether an intermittent fault is present, bool (...,).

    A two-state Markov chain: in the long run the fault is present in `share` of the observations
    and lasts `length_s` on average. If that is shorter than for independent observations, they are
    independent.

    Args:
        on: (...,) bool, whether it was present before.
        chance: (...,) uniform draws from 0 to 1.
        share: of the observations, below 1 [1].
        length_s: mean length [s].
        dt_s: time between observations [s].
    """
    xp = chance.__array_namespace__()
    ends = xp.minimum(dt_s / xp.maximum(length_s, 1e-9), 1.0 - share)
    begins = ends * share / (1.0 - share)
    return xp.where(on, chance >= ends, chance < begins)


def remembered(kept: Array) -> Array:
    """Return the noise factor of a first-order process, for its decay factor exp(-dt / tau)."""
    xp = kept.__array_namespace__()
    return xp.sqrt(xp.maximum(1.0 - kept**2, 0.0))


def length(vector: Array) -> Array:
    """Return |vector| (...,) with a finite slope at zero, exact to a micrometre."""
    xp = vector.__array_namespace__()
    return xp.sqrt((vector**2).sum(-1) + 1e-12)


def turned_by(rot_w: Array, before_w: Array) -> Array:
    """Return the rotation of a body since `before_w`, as a vector in its axes (..., 3) [rad].

    It is the sine of the angle along the axis: exact to 1 % below a quarter of a radian.
    """
    xp = rot_w.__array_namespace__()
    turn = (before_w[..., :, :, None] * rot_w[..., :, None, :]).sum(-3)
    return 0.5 * xp.stack(
        [
            turn[..., 2, 1] - turn[..., 1, 2],
            turn[..., 0, 2] - turn[..., 2, 0],
            turn[..., 1, 0] - turn[..., 0, 1],
        ],
        axis=-1,
    )


def product(a: Array, b: Array) -> Array:
    """Return the matrices a b (..., 3, 3), with the same rounding at every batch size."""
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def yawed(angle: Array) -> Array:
    """Return rotations about z (..., 3, 3) by `angle` (...,) [rad]."""
    xp = angle.__array_namespace__()
    cos, sin, zero = xp.cos(angle), xp.sin(angle), xp.zeros_like(angle)
    rows = ((cos, -sin, zero), (sin, cos, zero), (zero, zero, zero + 1.0))
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
