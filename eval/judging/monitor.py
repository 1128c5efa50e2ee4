"""A safety monitor around any policy: limits of tilt and speed, and evasive manoeuvres.

It uses the policy's observation only. The limits change an action; a manoeuvre replaces it, only
when necessary. Predicted paths of each manoeuvre (stop, climb, left, right, back and up) are
compared with the points of the depth image, for a start now and one decision later. While a
manoeuvre is still possible one decision later, the policy's action is flown. The judge and
real-time flights (`suite fly`) use the same monitor.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np

from eval.effects.interface import GRAVITY
from policies.policy import Hidden, Policy
from policies.spec import PolicyError, PolicySpec
from tracks.geometry.camera import Camera, pixel_rays_b
from tracks.input.ranges import Range

SAMPLES = 24
"""Points of a predicted path: 13 cm apart at 5 m/s."""


@dataclass(frozen=True)
class MonitorLimits:
    """Limits and settings of the monitor."""

    tilt_deg: Annotated[float, Range(1.0, 89.0)] = 75.0
    """Largest tilt that an action may command [deg]."""
    speed: Annotated[float, Range(0.1, 100.0)] = 12.0
    """Speed above which an action may not accelerate further [m/s]."""
    clearance_m: Annotated[float, Range(0.0, 10.0)] = 0.15
    """Least distance of a path from the points of the image [m]."""
    way_out: Annotated[float, Range(0.1, 100.0)] = 12.0
    """Acceleration of an evasive manoeuvre [m/s^2]."""
    lag_s: Annotated[float, Range(0.0, 1.0)] = 0.1
    """Time for which the last action still acts [s]."""
    horizon_s: Annotated[float, Range(0.05, 5.0)] = 0.6
    """Horizon of the prediction [s]."""


class Seen(NamedTuple):
    """Observations of N rows, converted for the monitor."""

    vel_b: np.ndarray
    """(N, 3) [m/s]."""
    up_b: np.ndarray
    """(N, 3) the world's z axis in body axes."""
    last_b: np.ndarray
    """(N, 3) the last action [m/s^2]."""
    points_b: np.ndarray
    """(N, P, 3) points of the depth image, body axes [m]."""
    hit: np.ndarray
    """(N, P) bool: whether the pixel shows an object within range."""


@dataclass
class Monitored:
    """A `Policy` with a monitor; `interventions` counts the evasive manoeuvres."""

    policy: Policy
    """The monitored policy."""
    limits: MonitorLimits = MonitorLimits()
    """Limits of the monitor."""
    interventions: int = field(default=0, compare=False)
    """Evasive manoeuvres so far, over all rows."""

    def __post_init__(self) -> None:
        """Refuse kinds of action and image that the monitor does not support."""
        action, depth = self.policy.spec.action, self.policy.spec.depth
        if action.kind != "acceleration" or not action.is_plain or depth.uint8:
            raise PolicyError(
                f"{self.policy.name}: the monitor is for accelerations in m/s^2 and float images; "
                "fly it without --monitor"
            )

    @property
    def name(self) -> str:
        """Name in tables."""
        return f"{self.policy.name}+monitor"

    @property
    def spec(self) -> PolicySpec:
        """The policy's own."""
        return self.policy.spec

    def start(self, n: int) -> Hidden:
        """Return the policy's hidden state of n trials."""
        return self.policy.start(n)

    def act(
        self, hidden: Hidden, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, Hidden]:
        """Return the policy's actions, limited or replaced where necessary."""
        action, hidden = self.policy.act(hidden, state, image, fresh)
        seen = seen_of(self.spec, state, image)
        bent = limited(self.limits, np.asarray(action, float), seen)
        found, taken = last_moment(self.limits, bent, seen, 1.0 / self.spec.rate_hz)
        self.interventions += int(taken.sum())
        return found.astype(np.float32), hidden


def seen_of(spec: PolicySpec, state: np.ndarray, image: np.ndarray) -> Seen:
    """Return velocity, attitude and surrounding points from an observation."""
    depth, camera = spec.depth, spec.camera
    metres = depth.scale / np.maximum(np.asarray(image, float) + depth.offset, 1e-3)
    metres = metres.reshape(len(metres), -1)
    points_b = _rays(camera) * metres[..., None]
    hit = metres < 0.99 * camera.range_m
    vel_b, up_b, last_b = (np.asarray(state[:, k : k + 3], float) for k in (0, 3, 9))
    return Seen(vel_b, up_b, last_b, points_b, hit)


def _rays(camera: Camera) -> np.ndarray:
    return np.asarray(pixel_rays_b(camera), float).reshape(-1, 3)


def limited(limits: MonitorLimits, action_b: np.ndarray, seen: Seen) -> np.ndarray:
    """Return actions (N, 3) within the limits of tilt and speed."""
    speed = np.linalg.norm(seen.vel_b, axis=-1, keepdims=True)
    ahead = seen.vel_b / np.maximum(speed, 1e-6)
    along = (action_b * ahead).sum(-1, keepdims=True)
    action_b = np.where((speed > limits.speed) & (along > 0), action_b - along * ahead, action_b)
    force_b = action_b + GRAVITY * seen.up_b
    lift = (force_b * seen.up_b).sum(-1, keepdims=True)
    aside = force_b - lift * seen.up_b
    most = np.tan(np.radians(limits.tilt_deg)) * np.maximum(lift, 1.0)
    size = np.linalg.norm(aside, axis=-1, keepdims=True)
    aside *= np.minimum(1.0, most / np.maximum(size, 1e-6))
    return lift * seen.up_b + aside - GRAVITY * seen.up_b


def ways_out(limits: MonitorLimits, seen: Seen) -> np.ndarray:
    """Return the actions (K, N, 3) of the manoeuvres: stop, climb, left, right, back and up."""
    speed = np.linalg.norm(seen.vel_b, axis=-1, keepdims=True)
    back = -seen.vel_b / np.maximum(speed, 0.5)
    left = np.cross(seen.up_b, -back)
    left /= np.maximum(np.linalg.norm(left, axis=-1, keepdims=True), 1e-6)
    sum_ = back + seen.up_b
    both = sum_ / np.maximum(np.linalg.norm(sum_, axis=-1, keepdims=True), 1e-6)
    return limits.way_out * np.stack([back, seen.up_b, left, -left, both])


def last_moment(
    limits: MonitorLimits, action_b: np.ndarray, seen: Seen, period_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the actions (N, 3) to fly, and which of them are manoeuvres (N,) bool.

    A way out is taken where the policy's path is blocked, every way out would be blocked if it
    began one decision later, and one that begins now is not, or clears more.
    """
    times = np.linspace(0.025, limits.horizon_s, SAMPLES)
    ahead = clearance(limits, seen, action_b, None, times, period_s)
    taken = np.zeros(len(action_b), bool)
    rows = np.flatnonzero(ahead < limits.clearance_m)
    if not len(rows):
        return action_b, taken
    part, wanted = Seen(*(x[rows] for x in seen)), action_b[rows]
    ways = ways_out(limits, part)
    later = np.stack([clearance(limits, part, wanted, way, times, period_s) for way in ways])
    now = np.stack([clearance(limits, part, way, None, times, period_s) for way in ways])
    best = now.argmax(0)
    pick = np.arange(len(rows))
    lost = (later < limits.clearance_m).all(0)
    better = now[best, pick] > np.maximum(ahead[rows], later.max(0))
    go = lost & better
    out = action_b.copy()
    out[rows[go]] = ways[best, pick][go]
    taken[rows[go]] = True
    return out, taken


def clearance(
    limits: MonitorLimits,
    seen: Seen,
    first_b: np.ndarray,
    then_b: np.ndarray | None,
    times: np.ndarray,
    period_s: float,
) -> np.ndarray:
    """Return the least distance (N,) of a path from the points of the image [m].

    Args:
        limits: with the lag.
        seen: of N rows.
        first_b: (N, 3) the action from now on [m/s^2].
        then_b: (N, 3) the action after a period; None: the same.
        times: (T,) of the path's points [s].
        period_s: between decisions [s].
    """
    path = seen.vel_b[:, None] * times[:, None]
    path += _moved(seen.last_b, times, 0.0) - _moved(seen.last_b, times, limits.lag_s)
    path += _moved(first_b, times, limits.lag_s)
    if then_b is not None:
        path += _moved(then_b - first_b, times, limits.lag_s + period_s)
    squared = (
        (path**2).sum(-1)[:, :, None]
        + (seen.points_b**2).sum(-1)[:, None, :]
        - 2.0 * path @ seen.points_b.swapaxes(1, 2)
    )
    nearest = np.where(seen.hit[:, None, :], squared, np.inf).min((1, 2))
    return np.sqrt(np.maximum(nearest, 0.0))


def _moved(action_b: np.ndarray, times: np.ndarray, since_s: float) -> np.ndarray:
    """Return the displacement (N, T, 3) by an acceleration since `since_s` [m]."""
    return 0.5 * action_b[:, None] * np.maximum(times - since_s, 0.0)[:, None] ** 2
