"""Where to be, as uniform cubic B-splines over time (de Boor 1978), differentiable in JAX."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from tracks.geometry.scene import Array

INTERVALS = 40
"""Of a spline; about 0.07 s each on a lap."""
REST = 100.0
"""Weight of the start from rest."""
NUMBERS = 3 * (INTERVALS + 3) + 1
"""That say a spline: its control points and its duration."""


class Spline(NamedTuple):
    """A path over time; rows of several have leading shapes."""

    control_w: Array
    """(..., INTERVALS + 3, 3) [m]."""
    duration_s: Array
    """(...,) [s]; the path goes on straight after it."""


class Along(NamedTuple):
    """A path at T times."""

    pos_w: Array
    """(T, 3) [m]."""
    vel_w: Array
    """(T, 3) [m/s]."""
    acc_w: Array
    """(T, 3) [m/s^2]."""


def packed(spline: Spline) -> Array:
    """Return the numbers (..., NUMBERS) that say `spline`."""
    flat = spline.control_w.reshape(*spline.control_w.shape[:-2], -1)
    return jnp.concatenate([flat, spline.duration_s[..., None]], axis=-1)


def unpacked(numbers: Array) -> Spline:
    """Return the spline that `numbers` (..., NUMBERS) say."""
    flat = numbers[..., :-1]
    return Spline(flat.reshape(*flat.shape[:-1], INTERVALS + 3, 3), numbers[..., -1])


def along(spline: Spline, time_s: Array) -> Along:
    """Return one spline's path at `time_s` (T,) [s], not negative."""
    step = spline.duration_s / INTERVALS
    place = jnp.minimum(time_s / step, INTERVALS)
    beyond = jnp.maximum(time_s - spline.duration_s, 0.0)[:, None]
    number = jax.lax.stop_gradient(jnp.minimum(jnp.floor(place), INTERVALS - 1)).astype(int)
    u = (place - number)[:, None]
    c = [spline.control_w[number + k] for k in range(4)]
    left = 1.0 - u
    pos = (left**3 * c[0] + (3 * u**3 - 6 * u**2 + 4) * c[1]) / 6
    pos += ((-3 * u**3 + 3 * u**2 + 3 * u + 1) * c[2] + u**3 * c[3]) / 6
    vel = -0.5 * left**2 * c[0] + (1.5 * u**2 - 2 * u) * c[1]
    vel += (-1.5 * u**2 + u + 0.5) * c[2] + 0.5 * u**2 * c[3]
    acc = left * c[0] + (3 * u - 2) * c[1] + (1 - 3 * u) * c[2] + u * c[3]
    vel, acc = vel / step, acc / step**2
    return Along(pos + beyond * vel, vel, jnp.where(beyond > 0.0, 0.0, acc))


def fitted(points_w: np.ndarray, duration_s: float, stiffness: float = 1.0) -> Spline:
    """Return the spline from rest whose path is nearest to points (T, 3), even in time [m].

    Args:
        points_w: the first one is where it starts.
        duration_s: [s].
        stiffness: weight of the control points' third differences.
    """
    count = INTERVALS + 3
    time_s = np.linspace(0.0, duration_s, len(points_w))
    some = np.repeat(np.eye(count)[:, :, None], 3, axis=-1)
    many = Spline(some, np.full(count, duration_s))
    weight = np.asarray(jax.vmap(along, (0, None))(many, time_s).pos_w[..., 0]).T
    bend = stiffness * np.diff(np.eye(count), 3, axis=0)
    left = np.concatenate([weight, bend, REST * np.eye(count)[:3]])
    start = np.tile(REST * points_w[0], (3, 1))
    right = np.concatenate([points_w, np.zeros((len(bend), 3)), start])
    return Spline(np.linalg.lstsq(left, right, rcond=None)[0], np.float64(duration_s))
