"""What a sensor model is: a few numbers, and how they change what a drone sees and knows.

A model is written once, over rows of NumPy or JAX arrays: the judge calls it with draws from each
trial's own seed, the trainer with draws from JAX keys. Randomness comes in as arrays, as many of
them whatever the magnitude, so that two magnitudes of one model have the same draws.
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
"""What models act on: estimated state, gates, depth image, inertial sensor."""


class Needs(NamedTuple):
    """How many random numbers a model takes."""

    normal: int = 0
    """Standard normal numbers."""
    uniform: int = 0
    """Numbers even from 0 to 1."""
    grain: int = 0
    """Images of standard normal numbers."""
    chance: int = 0
    """Images of numbers even from 0 to 1."""


class Draws(NamedTuple):
    """Random numbers of N rows, as many as `Needs` says."""

    normal: Array
    """(..., K)."""
    uniform: Array
    """(..., K)."""
    grain: Array
    """(..., K, H, W)."""
    chance: Array
    """(..., K, H, W)."""


class Moment(NamedTuple):
    """What a model is given of one observation, apart from what the models before it made of it."""

    truth: View
    """What there truly is, at the time of what is seen."""
    draws: Draws
    """Of this observation; for `start`, of the trial."""
    dt_s: Any
    """Time since the observation before [s]."""
    camera: Camera
    """The policy's."""


class Ages(NamedTuple):
    """How old what is seen is at a decision."""

    state_s: float = 0.0
    """Mean age of the state [s]."""
    image_s: float = 0.0
    """Mean age of the image [s]."""
    jitter: float = 0.0
    """Each decision's age is up to this share of the mean more or less, evenly [1]."""


class Inertial(NamedTuple):
    """A sample of an inertial measurement unit in body axes."""

    rate_b: Array
    """(..., 3) [rad/s]."""
    acc_b: Array
    """(..., 3) specific force [m/s^2]."""


@dataclass(frozen=True)
class Sensor:
    """A sensor or estimator model; a model has the hooks that it needs."""

    name: str
    """The `kind` of its table in a sensors file."""
    stage: str
    """The table of a sensors file that it stands in, one of `STAGES`."""
    summary: str
    """One sentence for people."""
    equation: str
    """What is seen, from what is."""
    source: str
    """Where the form and the usual sizes come from."""
    values: type
    """NamedTuple class with a field for each parameter, in order."""
    parameters: tuple[Parameter, ...]
    """All plain numbers; with the neutral values nothing is wrong."""
    grows: tuple[str, ...]
    """Parameters that grow with the magnitude; the others keep their values."""
    trial: Needs = Needs()
    """Draws at the start of a trial."""
    observation: Needs = Needs()
    """Draws of an observation; of an inertial model, of a sample."""
    start: Callable[[Values, Moment], Memory] | None = None
    """Returns what the model remembers at the first observation, from the trial's draws."""
    sense: Callable[[Values, Memory, View, Moment], tuple[View, Memory]] | None = None
    """Takes what the models before it made of the truth; returns what is seen, and the memory."""
    ages: Callable[[Values], Ages] | None = None
    """For a delay: how old what is seen is."""
    estimate: Callable[[Values], Any] | None = None
    """For an estimator in the loop: its `eval.sensors.filter.settings.FilterSettings`."""
    measure: Callable[[Values, Memory, Inertial, Draws, Any], tuple[Inertial, Memory]] | None = None
    """For an inertial sensor: (values, memory, truth, draws, dt_s) -> what it measures, memory."""


def column(value: Array) -> Array:
    """Return numbers (...,) as (..., 1), to multiply vectors."""
    return value[..., None]


def over_image(value: Array) -> Array:
    """Return numbers (...,) as (..., 1, 1), to multiply images."""
    return value[..., None, None]


def absent(values: Values, moment: Moment) -> Array:
    """Return, at the start, that a fault with one uniform draw a trial is not there (...,)."""
    del values
    return moment.draws.uniform[..., 0] < 0.0


def sticky(on: Array, chance: Array, share: Array, length_s: Array, dt_s: Any) -> Array:
    """Return whether a fault that comes and stays is there, bool (...,).

    A two-state Markov chain: in the long run the fault is there for `share` of the observations and
    lasts `length_s` on average; where that is shorter than chance alone gives, observations are
    independent.

    Args:
        on: (...,) bool, whether it was there before.
        chance: (...,) draws, even from 0 to 1.
        share: of the observations, below 1 [1].
        length_s: mean length [s].
        dt_s: time between observations [s].
    """
    xp = chance.__array_namespace__()
    ends = xp.minimum(dt_s / xp.maximum(length_s, 1e-9), 1.0 - share)
    begins = ends * share / (1.0 - share)
    return xp.where(on, chance >= ends, chance < begins)


def remembered(kept: Array) -> Array:
    """Return the share of a first-order process that one observation leaves, for exp(-dt / tau)."""
    xp = kept.__array_namespace__()
    return xp.sqrt(xp.maximum(1.0 - kept**2, 0.0))


def length(vector: Array) -> Array:
    """Return |vector| (...,) with a finite slope at zero, exact to a micrometre."""
    xp = vector.__array_namespace__()
    return xp.sqrt((vector**2).sum(-1) + 1e-12)


def turned_by(rot_w: Array, before_w: Array) -> Array:
    """Return how far a body has turned since `before_w`, as a vector in its axes (..., 3) [rad].

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
    """Return the matrices a b (..., 3, 3), rounded alike at every batch size."""
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def yawed(angle: Array) -> Array:
    """Return rotations about z (..., 3, 3) by `angle` (...,) [rad]."""
    xp = angle.__array_namespace__()
    cos, sin, zero = xp.cos(angle), xp.sin(angle), xp.zeros_like(angle)
    rows = ((cos, -sin, zero), (sin, cos, zero), (zero, zero, zero + 1.0))
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
