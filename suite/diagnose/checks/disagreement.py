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
from suite.diagnose.data.windows import STATE, STATE_GROUPS, FlightWindows
from suite.diagnose.evidence.rollout_model import RolloutModel
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.gap import HORIZONS_S, at_horizon, true_starts

UNITS = {
    "speed": "m/s",
    "height": "m",
    "body rates": "rad/s",
    "thrust": "m/s^2",
    "time in flight": "s",
}
"""What errors are held against, each at a rollout's start; the thrust is the mean of 0.5 s."""
CHANNELS = tuple(f"{group} {axis}" for group in STATE_GROUPS for axis in "xyz")
"""Names of the errors, in the body axes of the start."""


class Disagreement(NamedTuple):
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
    """The same with what was named; where nothing was, as before."""
    drift_before: np.ndarray
    """(W, 6) mean acceleration over 0.5 s that the model lacks [m/s^2], and the attitude's error
    after 0.5 s [rad], body axes."""
    drift_after: np.ndarray
    vel_b: np.ndarray
    """(W, 3) at the start, body axes [m/s]."""
    rate_b: np.ndarray
    """(W, 3) at the start [rad/s]."""


def find_disagreement(
    model: RolloutModel,
    vehicle: Vehicle,
    before: np.ndarray,
    after: np.ndarray | None,
    windows: FlightWindows,
    sigma: np.ndarray,
    start_sigma: np.ndarray,
    limits: Thresholds = THRESHOLDS,
) -> Disagreement:
    """Return the errors of rollouts from `windows`' starts.

    The numbers are `before` (P,) as the vehicle file has them, `after` with what was named, None
    where nothing was. `sigma` (19,) is the noise of each channel in its unit, `start_sigma` (F,)
    that of what a rollout starts from.
    """
    axes_b = np.swapaxes(np.asarray(windows.rot_w), 1, 2)
    linear = model.linearise(before, true_starts(model, before, windows), windows, model.starts)
    errors = [linear.residual, linear.residual]
    if after is not None:
        errors[1] = model.residual(after, true_starts(model, after, windows), windows)
    own = np.diag(np.where(np.isfinite(sigma), sigma, 0.0)[:STATE])
    turned = _in_body(axes_b, np.broadcast_to(own, (len(axes_b), STATE, STATE)))
    over: list[list[np.ndarray]] = [[] for _ in errors]
    for horizon in HORIZONS_S:
        at = at_horizon(windows, horizon)
        slope = _in_body(axes_b, linear.slope[at][:, :STATE])
        floor = np.sqrt((turned**2).sum(-1) + ((slope * start_sigma) ** 2).sum(-1))
        seen = np.asarray(windows.seen)[at][:, :STATE] & (at[1] > 0)[:, None]
        for found, residual in zip(over, errors, strict=True):
            error = _in_body(axes_b, residual[at][:, :STATE, None])[..., 0]
            found.append(np.where(seen, error / np.maximum(floor, 1e-12), np.nan))
    conditions = conditions_of(windows, vehicle, limits)
    starts = np.sort(np.asarray(windows.start_s))
    gaps = np.diff(starts)
    middle = at_horizon(windows, HORIZONS_S[1])
    drifts = [_drift(axes_b, residual, windows, middle) for residual in errors]
    stacked = [np.stack(found) for found in over]
    return Disagreement(
        conditions=conditions,
        edges={name: _edges(values, limits) for name, values in conditions.items()},
        stride_s=float(np.median(gaps[gaps > 1e-3])) if (gaps > 1e-3).any() else 1.0,
        before=stacked[0],
        after=stacked[1],
        drift_before=drifts[0],
        drift_after=drifts[1],
        vel_b=(axes_b @ np.asarray(windows.vel_w)[..., None])[..., 0],
        rate_b=np.asarray(windows.rate_b),
    )


def conditions_of(
    windows: FlightWindows, vehicle: Vehicle, limits: Thresholds = THRESHOLDS
) -> dict[str, np.ndarray]:
    """Return what each of W rollouts flew through, (W,) by the names of `UNITS`."""
    early = np.asarray(windows.command_s)
    early = (early > -1e-9) & (early < limits.thrust_mean_s)
    thrust = _mean(np.where(early, np.asarray(windows.command)[..., 0], np.nan).T)
    speed = np.asarray(windows.rotor_speed)
    if speed.any():
        early = np.asarray(windows.edge_s)[:, -speed.shape[1] - 1 : -1] < limits.thrust_mean_s
        force = vehicle.rotors.thrust_coefficient * (speed**2).sum(axis=-1)
        thrust = _mean(np.where(early, force, np.nan).T) / vehicle.mass
    return {
        "speed": np.linalg.norm(windows.vel_w, axis=-1),
        "height": np.asarray(windows.pos_w)[:, 2],
        "body rates": np.linalg.norm(windows.rate_b, axis=-1),
        "thrust": thrust,
        "time in flight": np.asarray(windows.start_s),
    }


def binned(found: Disagreement, over: np.ndarray, condition: str) -> tuple[np.ndarray, np.ndarray]:
    """Return RMS errors over their floor by bin (H, B, 12), and rollouts in each bin (B,).

    `over` (H, W, 12) is `found.before` or `found.after`.
    """
    place = _bin_of(found, condition)
    count = len(found.edges[condition]) - 1
    energy = over**2
    rows = [[_mean(energy[h][place == b]) for b in range(count)] for h in range(len(energy))]
    return np.sqrt(np.array(rows)), np.bincount(place, minlength=count)


def by_group(table: np.ndarray) -> np.ndarray:
    """Return RMS over the axes of each group (B, 4) of errors (B, 12)."""
    energy = (table**2).reshape(len(table), len(STATE_GROUPS), 3)
    seen = np.isfinite(energy)
    count = seen.sum(axis=2)
    total = np.where(seen, energy, 0.0).sum(axis=2)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def in_words(found: Disagreement, over: np.ndarray, limits: Thresholds = THRESHOLDS) -> str | None:
    """Return where `over` (H, W, 12) is furthest beyond noise, in words; None where nowhere.

    The error that stands out most is taken first, then what it goes with most clearly.
    """
    energy = over**2
    count = np.isfinite(energy).sum(axis=1)
    own = np.minimum(1.0, found.stride_s / np.array(HORIZONS_S))[:, None]
    mean = np.stack([_mean(part) for part in energy])
    beyond = np.nan_to_num((mean - 1.0) * np.sqrt(np.maximum(count * own, 1e-9) / 2.0))
    if beyond.max() < limits.beyond_noise:
        return None
    h, channel = np.unravel_index(int(beyond.argmax()), beyond.shape)
    values = energy[h, :, channel]
    subject = f"{CHANNELS[channel]} (body axes) after {HORIZONS_S[h]:g} s"
    p_values = {name: _p_value(values, _bin_of(found, name)) for name in found.conditions}
    condition = min(p_values, key=lambda name: p_values[name])
    if p_values[condition] > limits.condition_p_value:
        times = np.sqrt(mean[h, channel])
        return f"{subject}, {times:.1f} times what noise gives in all that was flown"
    line = binned(found, over, condition)[0][h, :, channel]
    most, least = int(np.nanargmax(line)), int(np.nanargmin(line))
    edges, unit = found.edges[condition], UNITS[condition]
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
    axes_b: np.ndarray,
    residual: np.ndarray,
    windows: FlightWindows,
    at: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    time = np.maximum(np.asarray(windows.row_s)[at], 1e-3)[:, None]
    error, seen = residual[at], np.asarray(windows.seen)[at]
    # Where no velocity was measured the position says the same, less exactly.
    acc_w = np.where(seen[:, 6:9], error[:, 6:9] / time, 2.0 * error[:, :3] / time**2)
    acc_b = (axes_b @ acc_w[..., None])[..., 0]
    drift = np.concatenate([acc_b, error[:, 3:6]], axis=1)
    return np.where(seen[:, :1] & seen[:, 3:4], drift, np.nan)


def _edges(values: np.ndarray, limits: Thresholds) -> np.ndarray:
    bins = int(np.clip(len(values) // (2 * limits.least_in_bin), 1, limits.most_bins))
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, bins + 1)))
    if len(edges) < 2:
        edges = np.array([edges[0] - 0.5, edges[0] + 0.5])
    return edges


def _bin_of(found: Disagreement, condition: str) -> np.ndarray:
    edges = found.edges[condition]
    place = np.searchsorted(edges, found.conditions[condition], side="right") - 1
    return np.clip(place, 0, len(edges) - 2)


def _mean(energy: np.ndarray) -> np.ndarray:
    """Return the mean over the first axis of what is there, NaN where nothing is."""
    good = np.isfinite(energy)
    total = np.where(good, energy, 0.0).sum(axis=0)
    count = good.sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _p_value(energy: np.ndarray, place: np.ndarray) -> float:
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
