"""A safety monitor around any policy: limits of tilt and speed, and evasive manoeuvres.

It uses the policy's observation only. The limits change an action; a manoeuvre replaces it, but
only when necessary. The five manoeuvres are: stop, climb, left, right, and back with climb. The
path of each is predicted for a start now and for a start one decision later, and compared with the
points of the depth image. While a manoeuvre is still possible one decision later, the policy's
action is flown. The judge and real-time flights (`suite fly`) use the same monitor.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eval.effects.interface import GRAVITY
from policies.policy import Hidden, Policy, Wrapper
from policies.spec import PolicyError, PolicySpec
from tracks.geometry.camera import pixel_rays_b

SAMPLES = 24
"""Number of points of a predicted path, which are 13 cm apart at 5 m/s."""
FIRST_S = 0.025
"""Time of the first point of a predicted path [s]."""
HIT_SHARE = 0.99
"""Depths below this share of the camera's range count as an object."""
LIFT_LEAST = 1.0
"""Vertical specific forces below this count as this, when the largest horizontal one is computed
[m/s^2]."""
STOP_SPEED = 0.5
"""Speed below which the deceleration of the manoeuvre "stop" becomes weaker [m/s]."""
TILT_DEG = 75.0
"""Largest tilt that an action may command [deg]."""
MOST_SPEED = 12.0
"""Speed above which an action may not accelerate further [m/s]."""
CLEARANCE_M = 0.15
"""Least allowed distance of a path from the points of the image [m]."""
WAY_OUT = 12.0
"""Acceleration of an evasive manoeuvre [m/s^2]."""
LAG_S = 0.1
"""Time for which the last action still acts [s]."""
HORIZON_S = 0.6
"""Horizon of the prediction [s]."""


class Seen(NamedTuple):
    """Observations of N rows (trials), converted for the monitor."""

    vel_b: np.ndarray
    """(N, 3) velocity in body axes [m/s]."""
    up_b: np.ndarray
    """(N, 3) the world's z axis in body axes."""
    last_b: np.ndarray
    """(N, 3) the last action [m/s^2]."""
    points_b: np.ndarray
    """(N, P, 3) points of the depth image, body axes [m]."""
    hit: np.ndarray
    """(N, P) bool, whether the pixel shows an object within the camera's range."""


class Monitored(Wrapper):
    """A `Policy` that runs another policy and monitors its actions."""

    def __init__(self, policy: Policy) -> None:
        """Refuse kinds of action and image that the monitor does not support."""
        super().__init__(policy)
        action, depth = policy.spec.action, policy.spec.depth
        if action.kind != "acceleration" or not action.is_plain or depth.uint8:
            raise PolicyError(
                f"{policy.name}: the monitor supports only accelerations in m/s^2 and float "
                "images; fly it without --monitor"
            )
        self.name = f"{policy.name}+monitor"
        self.interventions = 0
        """Number of evasive manoeuvres so far, over all rows."""

    def act(
        self, hidden: Hidden, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, Hidden]:
        """Return the policy's actions (n, 3), limited or replaced where necessary."""
        action, hidden = super().act(hidden, state, image, fresh)
        seen = seen_of(self.spec, state, image)
        action_b = limited(np.asarray(action, float), seen)
        action_b, replaced = last_moment(action_b, seen, 1.0 / self.spec.rate_hz)
        self.interventions += int(replaced.sum())
        return action_b.astype(np.float32), hidden


def seen_of(spec: PolicySpec, state: np.ndarray, image: np.ndarray) -> Seen:
    """Return velocity, attitude and surrounding points from observations (N, ...)."""
    depth, camera = spec.depth, spec.camera
    depth_m = depth.scale / np.maximum(np.asarray(image, float) + depth.offset, 1e-3)
    depth_m = depth_m.reshape(len(depth_m), -1)
    points_b = np.asarray(pixel_rays_b(camera), float).reshape(-1, 3) * depth_m[..., None]
    hit = depth_m < HIT_SHARE * camera.range_m
    vel_b, up_b, last_b = (np.asarray(state[:, k : k + 3], float) for k in (0, 3, 9))
    return Seen(vel_b, up_b, last_b, points_b, hit)


def limited(action_b: np.ndarray, seen: Seen) -> np.ndarray:
    """Return actions (N, 3) [m/s^2] reduced to the limits of tilt and speed."""
    speed = np.linalg.norm(seen.vel_b, axis=-1, keepdims=True)
    ahead = seen.vel_b / np.maximum(speed, 1e-6)
    along = (action_b * ahead).sum(-1, keepdims=True)
    action_b = np.where((speed > MOST_SPEED) & (along > 0), action_b - along * ahead, action_b)
    # The specific force is along the thrust, so its direction is the tilt.
    force_b = action_b + GRAVITY * seen.up_b
    lift = (force_b * seen.up_b).sum(-1, keepdims=True)
    horizontal_b = force_b - lift * seen.up_b
    largest_horizontal = np.tan(np.radians(TILT_DEG)) * np.maximum(lift, LIFT_LEAST)
    size = np.linalg.norm(horizontal_b, axis=-1, keepdims=True)
    horizontal_b *= np.minimum(1.0, largest_horizontal / np.maximum(size, 1e-6))
    return lift * seen.up_b + horizontal_b - GRAVITY * seen.up_b


def ways_out(seen: Seen) -> np.ndarray:
    """Return the actions (5, N, 3) [m/s^2]: stop, climb, left, right, and back with climb."""
    speed = np.linalg.norm(seen.vel_b, axis=-1, keepdims=True)
    back = -seen.vel_b / np.maximum(speed, STOP_SPEED)
    left = np.cross(seen.up_b, -back)
    left /= np.maximum(np.linalg.norm(left, axis=-1, keepdims=True), 1e-6)
    back_and_up = back + seen.up_b
    back_and_up /= np.maximum(np.linalg.norm(back_and_up, axis=-1, keepdims=True), 1e-6)
    return WAY_OUT * np.stack([back, seen.up_b, left, -left, back_and_up])


def last_moment(action_b: np.ndarray, seen: Seen, period_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the actions (N, 3) [m/s^2] to fly, and which of them are manoeuvres (N,).

    A manoeuvre replaces the policy's action if three conditions hold: the policy's path is
    blocked; every manoeuvre would be blocked if it began one decision later; and the best one that
    begins now has more clearance than all of these.
    """
    times = np.linspace(FIRST_S, HORIZON_S, SAMPLES)
    policy_clearance = clearance(seen, action_b, None, times, period_s)
    replaced = np.zeros(len(action_b), bool)
    rows = np.flatnonzero(policy_clearance < CLEARANCE_M)
    if not len(rows):
        return action_b, replaced
    seen_blocked, policy_b = Seen(*(x[rows] for x in seen)), action_b[rows]
    ways = ways_out(seen_blocked)
    later = np.stack([clearance(seen_blocked, policy_b, way, times, period_s) for way in ways])
    now = np.stack([clearance(seen_blocked, way, None, times, period_s) for way in ways])
    best = now.argmax(0)
    columns = np.arange(len(rows))
    blocked_later = (later < CLEARANCE_M).all(0)
    is_better = now[best, columns] > np.maximum(policy_clearance[rows], later.max(0))
    chosen = blocked_later & is_better
    flown_b = action_b.copy()
    flown_b[rows[chosen]] = ways[best, columns][chosen]
    replaced[rows[chosen]] = True
    return flown_b, replaced


def clearance(
    seen: Seen,
    first_b: np.ndarray,
    then_b: np.ndarray | None,
    times: np.ndarray,
    period_s: float,
) -> np.ndarray:
    """Return the least distance (N,) of a path from the points of the image [m].

    Args:
        seen: observations of N rows.
        first_b: (N, 3) the action from now on [m/s^2].
        then_b: (N, 3) the action after one period [m/s^2]; None: `first_b` continues.
        times: (T,) times of the path's points [s].
        period_s: time between decisions [s].
    """
    path = seen.vel_b[:, None] * times[:, None]
    # The last action acts for `LAG_S`, then the new one.
    until_lag = _displacement(seen.last_b, times, 0.0)
    path += until_lag - _displacement(seen.last_b, times, LAG_S)
    path += _displacement(first_b, times, LAG_S)
    if then_b is not None:
        path += _displacement(then_b - first_b, times, LAG_S + period_s)
    # Squared distances |path|^2 + |point|^2 - 2 path . point, (N, T, P).
    squared = (
        (path**2).sum(-1)[:, :, None]
        + (seen.points_b**2).sum(-1)[:, None, :]
        - 2.0 * path @ seen.points_b.swapaxes(1, 2)
    )
    nearest = np.where(seen.hit[:, None, :], squared, np.inf).min((1, 2))
    return np.sqrt(np.maximum(nearest, 0.0))


def _displacement(action_b: np.ndarray, times: np.ndarray, since_s: float) -> np.ndarray:
    """Return the displacement (N, T, 3) [m] by an acceleration (N, 3) that begins at `since_s`."""
    return 0.5 * action_b[:, None] * np.maximum(times - since_s, 0.0)[:, None] ** 2
