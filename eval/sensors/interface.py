"""The interface of a sensor model: the `Sensor` dataclass, its inputs, and shared functions.

A model is written once, for NumPy and JAX arrays whose rows are drones. The judge, which flies and
scores policies, passes random numbers from each trial's seed; the trainer passes numbers from JAX
keys. How many numbers a model needs does not depend on the magnitude of its errors, so two
magnitudes of one model use the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from policies.observation import View
from tracks.geometry.camera import Camera
from tracks.geometry.scene import Array

if TYPE_CHECKING:
    import jax

Values = Any
"""The parameters of a model: its NamedTuple of floats or arrays (...,)."""
Memory = Any
"""The state of a model between observations: arrays (..., K), or tuples and dicts of them."""
STAGES = ("state", "gates", "depth", "imu")
"""Stages, named after what a model changes: estimated state, gates, depth image, inertial unit."""


class Parameter(NamedTuple):
    """One parameter of a model, a number; without it in a sensors file it has the neutral value."""

    name: str
    """Name in sensors files."""
    unit: str
    """SI unit."""
    neutral: float
    """Value that gives no errors, or the usual one where a model always needs one."""
    low: float
    """Smallest allowed value."""
    high: float
    """Largest allowed value."""
    typical: tuple[float, float]
    """Smallest and largest usual value."""


class Needs(NamedTuple):
    """How many random numbers a model needs, of each distribution."""

    normal: int = 0
    """Number of standard normal numbers."""
    uniform: int = 0
    """Number of uniform numbers from 0 to 1."""
    grain: int = 0
    """Number of images of standard normal numbers, with one number a pixel."""
    chance: int = 0
    """Number of images of uniform numbers from 0 to 1, with one number a pixel."""


class Draws(NamedTuple):
    """Random numbers of a model; K is the count in the field of `Needs` with the same name."""

    normal: Array
    """(..., K) standard normal numbers."""
    uniform: Array
    """(..., K) uniform numbers from 0 to 1."""
    grain: Array
    """(..., K, H, W) standard normal numbers, one for each pixel."""
    chance: Array
    """(..., K, H, W) uniform numbers from 0 to 1, one for each pixel."""


class Moment(NamedTuple):
    """Inputs of a model for one observation, in addition to the view."""

    truth: View
    """The true view, at the time of the observation."""
    draws: Draws
    """Random numbers of this observation; for `start`, of the trial."""
    dt_s: Any
    """Time since the previous observation [s]."""
    camera: Camera
    """The policy's camera."""


class Ages(NamedTuple):
    """Ages of an observation when the policy uses it."""

    state_s: float = 0.0
    """Mean age of the state [s]."""
    image_s: float = 0.0
    """Mean age of the image [s]."""
    jitter: float = 0.0
    """Largest relative deviation of an age from its mean; deviations are uniformly distributed."""


class Inertial(NamedTuple):
    """A sample of an inertial measurement unit in body axes."""

    rate_b: Array
    """(..., 3) body rates [rad/s]."""
    acc_b: Array
    """(..., 3) specific force [m/s^2]."""


@dataclass(frozen=True)
class Sensor:
    """A sensor or estimator model; functions that it does not need are None."""

    name: str
    """Name of the model, the `kind` of its table in a sensors file."""
    stage: str
    """Name of the table in a sensors file, one of `STAGES`."""
    summary: str
    """One sentence for help texts and the documentation."""
    equation: str
    """The observation as a function of the truth."""
    source: str
    """Publications from which the equation and the usual sizes of the errors are."""
    values: type
    """NamedTuple class with a field for each parameter, in order."""
    parameters: tuple[Parameter, ...]
    """Bounds, unit and usual size of each parameter; the neutral values give no errors."""
    grows: tuple[str, ...]
    """Parameters that scale with the magnitude of the errors; the others are constant."""
    trial: Needs = Needs()
    """Random numbers at the start of a trial."""
    observation: Needs = Needs()
    """Random numbers of one observation; for an inertial sensor, of one sample."""
    start: Callable[[Values, Moment], Memory] | None = None
    """Returns the model's state at the first observation, from the trial's draws."""
    sense: Callable[[Values, Memory, View, Moment], tuple[View, Memory]] | None = None
    """Takes the view that earlier models have changed; returns the changed view and new state."""
    ages: Callable[[Values], Ages] | None = None
    """For a delay: returns the ages of the observation."""
    estimate: Callable[[Values], Any] | None = None
    """For a state estimator: returns its settings, an `eval.sensors.gate_filter.GateFilter`."""
    measure: Callable[[Values, Memory, Inertial, Draws, Any], tuple[Inertial, Memory]] | None = None
    """For an inertial sensor: (values, state, truth, draws, dt_s) -> measurement, state."""


def column(value: Array) -> Array:
    """Return numbers (...,) as (..., 1), for products with vectors."""
    return value[..., None]


def over_image(value: Array) -> Array:
    """Return numbers (...,) as (..., 1, 1), for products with images."""
    return value[..., None, None]


def starts_absent(values: Values, moment: Moment) -> Array:
    """Return the state of an intermittent fault at the start, absent: False (...,).

    The model must have one uniform draw in a trial, whose shape the result gets.
    """
    del values
    return moment.draws.uniform[..., 0] < 0.0


def markov_step(on: Array, chance: Array, share: Array, length_s: Array, dt_s: Any) -> Array:
    """Return whether an intermittent fault is present at the next observation, bool (...,).

    The fault is a two-state Markov chain: in the long run it is present in `share` of the
    observations and lasts `length_s` on average. For a short `length_s` the observations are
    independent: a fault then lasts as long as chance makes it last.

    Args:
        on: (...,) bool, whether the fault was present at the previous observation.
        chance: (...,) uniform draws from 0 to 1.
        share: share of the observations with the fault, below 1.
        length_s: mean duration of the fault [s].
        dt_s: time between observations [s].
    """
    xp = chance.__array_namespace__()
    ends = xp.minimum(dt_s / xp.maximum(length_s, 1e-9), 1.0 - share)
    begins = ends * share / (1.0 - share)
    return xp.where(on, chance >= ends, chance < begins)


def noise_factor(decay: Array) -> Array:
    """Return the factor of the white noise that keeps a first-order process at unit variance.

    The process's value decays by the factor exp(-dt / tau) in a step.
    """
    xp = decay.__array_namespace__()
    return xp.sqrt(xp.maximum(1.0 - decay**2, 0.0))


def length(vector: Array) -> Array:
    """Return the norm (...,) of vectors, differentiable at zero, with an error below 1e-6."""
    xp = vector.__array_namespace__()
    return xp.sqrt((vector**2).sum(-1) + 1e-12)


def rotation_since(rot_w: Array, before_w: Array) -> Array:
    """Return the rotation of a body since `before_w`, as a vector in its axes (..., 3) [rad].

    The vector is the axis times the sine of the angle. Below 0.25 rad it is within 1 % of the
    rotation vector. Both attitudes (..., 3, 3) are body to world.
    """
    xp = rot_w.__array_namespace__()
    relative = (before_w[..., :, :, None] * rot_w[..., :, None, :]).sum(-3)
    return 0.5 * xp.stack(
        [
            relative[..., 2, 1] - relative[..., 1, 2],
            relative[..., 0, 2] - relative[..., 2, 0],
            relative[..., 1, 0] - relative[..., 0, 1],
        ],
        axis=-1,
    )


def product(a: Array, b: Array) -> Array:
    """Return the matrix products a b (..., 3, 3), with the same rounding at every batch size."""
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def blank_draws(needs: Needs, rows: int, camera: Camera) -> Draws:
    """Return arrays of zeros for the draws `needs` of `rows` drones."""
    shape = camera.height, camera.width
    return Draws(
        np.zeros((rows, needs.normal)),
        np.zeros((rows, needs.uniform)),
        np.zeros((rows, needs.grain, *shape)),
        np.zeros((rows, needs.chance, *shape)),
    )


def blank_model_draws(
    models: Iterable[Sensor], rows: int, camera: Camera
) -> tuple[dict[str, Draws], dict[str, Draws]]:
    """Return arrays of zeros for the draws of a trial and of an observation, by model."""
    models = list(models)
    trial = {model.name: blank_draws(model.trial, rows, camera) for model in models}
    observation = {model.name: blank_draws(model.observation, rows, camera) for model in models}
    return trial, observation


def draw(into: Draws, row: int, generator: np.random.Generator) -> None:
    """Draw the random numbers of drone `row`, in place: see `Draws` for the distributions."""
    fills = {
        "normal": generator.standard_normal,
        "uniform": generator.random,
        "grain": generator.standard_normal,
        "chance": generator.random,
    }
    for field, numbers in into._asdict().items():
        if numbers[row].size:
            fills[field](out=numbers[row])


def keyed_draws(needs: Needs, key: jax.Array, camera: Camera) -> Draws:
    """Return the random numbers of one drone from a JAX `key`."""
    import jax

    shape = camera.height, camera.width
    keys = jax.random.split(key, 4)
    return Draws(
        jax.random.normal(keys[0], (needs.normal,)),
        jax.random.uniform(keys[1], (needs.uniform,)),
        jax.random.normal(keys[2], (needs.grain, *shape)),
        jax.random.uniform(keys[3], (needs.chance, *shape)),
    )
