"""Where model and flights disagree: errors of short rollouts against what was flown through.

Rollouts of 0.1, 0.5 and 1 s start from measured states. Their errors, in the body axes of the
start, are held against the noise floor: what the noise of the start and of the row that is compared
would make of a perfect model.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.stats import f as fisher

from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.windows import HISTORY_S, WARM_S, Windows, step_s
from suite.diagnose.fit.model import Model
from suite.diagnose.fit.rollout import STATE
from suite.diagnose.verdict.gap import HORIZONS_S, true_starts

UNITS = {
    "speed": "m/s",
    "height": "m",
    "body rates": "rad/s",
    "thrust": "m/s^2",
    "time in flight": "s",
}
"""What errors are held against, each at a rollout's start; the thrust is the mean of 0.5 s."""
GROUPS = ("position", "attitude", "velocity", "rates")
CHANNELS = tuple(f"{group} {axis}" for group in GROUPS for axis in "xyz")
"""Names of the errors, in the body axes of the start."""
MOST_BINS = 6
LEAST_COUNT = 8
"""Rollouts in a bin, at least."""
THRUST_S = 0.5
BEYOND = 4.0
"""Errors are beyond noise where their energy is off by more standard errors than this."""
GOES_WITH = 1e-3
"""Chance below which errors are said to go with a condition."""


class Where(NamedTuple):
    """Errors of W rollouts at H horizons."""

    conditions: Mapping[str, np.ndarray]
    """(W,) by name."""
    edges: Mapping[str, np.ndarray]
    """Bin edges by condition."""
    stride_s: float
    """From one rollout's start to the next [s]; longer ones share rows."""
    before: np.ndarray
    """(H, W, 12) error over its noise floor; NaN where nothing was measured."""
    after: np.ndarray
    """The same with what was named."""
    drift_before: np.ndarray
    """(W, 6) mean acceleration over 0.5 s that the model lacks [m/s^2], and the attitude's error
    after 0.5 s [rad], body axes."""
    drift_after: np.ndarray
    vel_b: np.ndarray
    """(W, 3) at the start, body axes [m/s]."""
    rate_b: np.ndarray
    """(W, 3) at the start [rad/s]."""


def look_where(
    model: Model,
    vehicle: Vehicle,
    before: np.ndarray,
    after: np.ndarray,
    windows: Windows,
    sigma: np.ndarray,
    start_sigma: np.ndarray,
) -> Where:
    """Return the errors of rollouts from `windows`' starts.

    Args:
        model: of the windows.
        vehicle: whose steps and thrust count.
        before: (P,) the model's numbers as the vehicle file has them.
        after: (P,) with what was named.
        windows: one a rollout.
        sigma: (19,) noise of each channel.
        start_sigma: (F,) noise of what a rollout starts from.
    """
    axes_b = np.swapaxes(np.asarray(windows.rot_w), 1, 2)
    starts = true_starts(model, before, windows)
    linear = model.linearise(before, starts, windows, model.starts)
    slopes = linear.slope
    errors = {"before": linear.residual}
    errors["after"] = errors["before"]
    if not np.array_equal(before, after):
        starts = true_starts(model, after, windows)
        errors["after"] = model.residual(after, starts, windows)
    own = np.where(np.isfinite(sigma), sigma, 0.0)[:STATE]
    rows = [np.abs(np.asarray(windows.row_s) - h).argmin(axis=1) for h in HORIZONS_S]
    every = np.arange(len(axes_b))
    floors = []
    for row in rows:
        slope = _in_body(axes_b, slopes[every, row][:, :STATE])
        turned = _in_body(axes_b, np.broadcast_to(np.diag(own), (len(row), STATE, STATE)))
        floors.append(np.sqrt((turned**2).sum(-1) + ((slope * start_sigma) ** 2).sum(-1)))
    found = {}
    for name, residual in errors.items():
        over = []
        for row, floor in zip(rows, floors, strict=True):
            error = _in_body(axes_b, residual[every, row][:, :STATE, None])[..., 0]
            seen = np.asarray(windows.seen)[every, row, :STATE] & (row > 0)[:, None]
            over.append(np.where(seen, error / np.maximum(floor, 1e-12), np.nan))
        found[name] = np.stack(over)
    conditions = conditions_of(windows, vehicle)
    start_s = np.sort(np.asarray(windows.start_s))
    gaps = np.diff(start_s)
    return Where(
        conditions=conditions,
        edges={name: _edges(values) for name, values in conditions.items()},
        stride_s=float(np.median(gaps[gaps > 1e-3])) if (gaps > 1e-3).any() else 1.0,
        before=found["before"],
        after=found["after"],
        drift_before=_drift(axes_b, errors["before"], windows, rows[1]),
        drift_after=_drift(axes_b, errors["after"], windows, rows[1]),
        vel_b=(axes_b @ np.asarray(windows.vel_w)[..., None])[..., 0],
        rate_b=np.asarray(windows.rate_b),
    )


def conditions_of(windows: Windows, vehicle: Vehicle) -> dict[str, np.ndarray]:
    """Return what each of W rollouts flew through, (W,) by the names of `UNITS`."""
    dt = step_s(vehicle)
    first = round(HISTORY_S / dt) + 1 + round(WARM_S / dt)
    steps = round(THRUST_S / dt)
    thrust = np.asarray(windows.command)[:, first : first + steps, 0].mean(axis=1)
    speed = np.asarray(windows.rotor_speed)[:, :steps]
    if speed.any():
        force = vehicle.rotors.thrust_coefficient * (speed**2).sum(axis=-1)
        thrust = force.mean(axis=1) / vehicle.mass
    return {
        "speed": np.linalg.norm(windows.vel_w, axis=-1),
        "height": np.asarray(windows.pos_w)[:, 2],
        "body rates": np.linalg.norm(windows.rate_b, axis=-1),
        "thrust": thrust,
        "time in flight": np.asarray(windows.start_s),
    }


def binned(where: Where, over: np.ndarray, condition: str) -> tuple[np.ndarray, np.ndarray]:
    """Return RMS errors over their floor by bin (H, B, 12), and rollouts in each bin (B,).

    Args:
        where: whose bins are used.
        over: (H, W, 12), `where.before` or `where.after`.
        condition: its name.
    """
    place = _bin_of(where, condition)
    count = len(where.edges[condition]) - 1
    energy = over**2
    rows = [[_mean(energy[h][place == b]) for b in range(count)] for h in range(len(energy))]
    return np.sqrt(np.array(rows)), np.bincount(place, minlength=count)


def in_words(where: Where, over: np.ndarray) -> str | None:
    """Return where `over` is furthest beyond noise, in words; None where nowhere.

    The error that stands out most is taken first, then what it goes with most clearly.
    """
    energy = over**2
    count = np.isfinite(energy).sum(axis=1)
    own = np.minimum(1.0, where.stride_s / np.array(HORIZONS_S))[:, None]
    mean = np.stack([_mean(part) for part in energy])
    beyond = np.nan_to_num((mean - 1.0) * np.sqrt(np.maximum(count * own, 1e-9) / 2.0))
    if beyond.max() < BEYOND:
        return None
    h, channel = np.unravel_index(int(beyond.argmax()), beyond.shape)
    values = energy[h, :, channel]
    subject = f"{CHANNELS[channel]} (body axes) after {HORIZONS_S[h]:g} s"
    chances = {name: _chance(values, _bin_of(where, name)) for name in where.conditions}
    condition = min(chances, key=lambda name: chances[name])
    if chances[condition] > GOES_WITH:
        times = np.sqrt(mean[h, channel])
        return f"{subject}, {times:.1f} times what noise gives in all that was flown"
    table, _ = binned(where, over, condition)
    line = table[h, :, channel]
    most, least = int(np.nanargmax(line)), int(np.nanargmin(line))
    edges, unit = where.edges[condition], UNITS[condition]
    return (
        f"{subject} at a {condition} of {edges[most]:.3g} to {edges[most + 1]:.3g} {unit}: "
        f"{line[most]:.1f} times what noise gives ({line[least]:.1f} times at "
        f"{edges[least]:.3g} to {edges[least + 1]:.3g} {unit})"
    )


def _in_body(axes_b: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return (W, 12, K) with position and velocity turned into the body axes of the start."""
    position, attitude, velocity, rates = np.split(values, 4, axis=1)
    return np.concatenate([axes_b @ position, attitude, axes_b @ velocity, rates], axis=1)


def _drift(
    axes_b: np.ndarray, residual: np.ndarray, windows: Windows, row: np.ndarray
) -> np.ndarray:
    every = np.arange(len(row))
    time = np.maximum(np.asarray(windows.row_s)[every, row], 1e-3)[:, None]
    error = residual[every, row]
    seen = np.asarray(windows.seen)[every, row]
    # Where no velocity was measured the position says the same, less exactly.
    acc_w = np.where(seen[:, 6:9], error[:, 6:9] / time, 2.0 * error[:, :3] / time**2)
    acc_b = (axes_b @ acc_w[..., None])[..., 0]
    drift = np.concatenate([acc_b, error[:, 3:6]], axis=1)
    return np.where(seen[:, :1] & seen[:, 3:4], drift, np.nan)


def _edges(values: np.ndarray) -> np.ndarray:
    bins = int(np.clip(len(values) // (2 * LEAST_COUNT), 1, MOST_BINS))
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, bins + 1)))
    if len(edges) < 2:
        edges = np.array([edges[0] - 0.5, edges[0] + 0.5])
    return edges


def _bin_of(where: Where, condition: str) -> np.ndarray:
    edges = where.edges[condition]
    place = np.searchsorted(edges, where.conditions[condition], side="right") - 1
    return np.clip(place, 0, len(edges) - 2)


def _mean(energy: np.ndarray) -> np.ndarray:
    """Return the mean over the first axis of what is there, NaN where nothing is."""
    good = np.isfinite(energy)
    total = np.where(good, energy, 0.0).sum(axis=0)
    count = good.sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _chance(energy: np.ndarray, place: np.ndarray) -> float:
    """Return the p-value of energies differing between bins (analysis of variance of logs)."""
    good = np.isfinite(energy)
    values, place = np.log(energy[good] + 0.1), place[good]
    groups = [values[place == b] for b in np.unique(place)]
    within = sum(float(((g - g.mean()) ** 2).sum()) for g in groups)
    freedom = len(values) - len(groups)
    if len(groups) < 2 or freedom < 2 or within <= 0.0:
        return 1.0
    middle = values.mean()
    between = sum(len(g) * float((g.mean() - middle) ** 2) for g in groups)
    ratio = between / (len(groups) - 1) / (within / freedom)
    return float(fisher.sf(ratio, len(groups) - 1, freedom))
