"""What stands beside the names: the logs, where they disagree, the actuators, a black box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.logs.velocity import velocity_from_position
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.actuators import Apart, actuators_apart
from suite.diagnose.data.kinematics import Kinematics, LogFacts, check_kinematics, facts_of
from suite.diagnose.data.windows import Windows, cut, take
from suite.diagnose.diagnose import Diagnosis
from suite.diagnose.fit.normal_equations import rotor_spread
from suite.diagnose.fit.rollout import STATE
from suite.diagnose.verdict.black_box import Contest, Contests
from suite.diagnose.verdict.gap import HORIZONS_S, Gap, interval, true_starts
from suite.diagnose.verdict.where import GROUPS, UNITS, Where, binned, in_words, look_where

STRIDE_S = 0.5
"""From one rollout's start to the next where they are held against what was flown [s]."""
ASTRAY_M = 50.0
"""Rollouts that end further from the record than this are left out [m]."""
DIGITS = 4


@dataclass(frozen=True)
class Proof:
    """All that a report shows besides the search."""

    facts: list[LogFacts]
    kinematics: Kinematics | None
    where: Where
    actuators: list[Apart]
    contests: Contests | None = None


def gather(result: Diagnosis, logs: Sequence[FlightLog], vehicle: Vehicle) -> Proof:
    """Return what stands beside the names of `result`, but for the black box.

    Args:
        result: the diagnosis of `logs`.
        logs: the flights.
        vehicle: the one that the simulation used.
    """
    windows, _ = cut(logs, vehicle, result.driven_by != "commands", STRIDE_S)
    assert windows is not None  # the diagnosis has cut them before
    model, sigma = result.model, result.finding.sigma
    start = model.space.array("start")
    residual = model.residual(start, true_starts(model, start, windows), windows)
    near = np.isfinite(residual).all(axis=(1, 2))
    near &= (np.abs(residual[..., :3]) < ASTRAY_M).all(axis=(1, 2))
    windows = take(windows, near)
    after = result.finding.state.theta if result.finding.named else start
    noise = start_noise(sigma, windows, logs, model.free)
    return Proof(
        facts=[facts_of(log) for log in logs],
        kinematics=check_kinematics(logs),
        where=look_where(model, vehicle, start, after, windows, sigma, noise),
        actuators=actuators_apart(logs, vehicle),
    )


def start_noise(
    sigma: np.ndarray, windows: Windows, logs: Sequence[FlightLog], free: int
) -> np.ndarray:
    """Return the noise (F,) of what a rollout starts from.

    A velocity that was derived from positions is as noisy as the derivation makes it.
    """
    noise = np.zeros(free)
    own = sigma[:STATE].copy()
    if not np.isfinite(own[6:9]).all():
        own[6:9] = _derived(logs[0]) * own[:3]
    noise[:STATE] = np.where(np.isfinite(own), own, 0.0)
    if free > STATE:
        noise[STATE:] = rotor_spread(windows)
    return noise


def _derived(log: FlightLog) -> float:
    """Return the noise of a derived velocity over that of the positions [1/s]."""
    draws = np.random.default_rng(0).standard_normal((len(log.time_s), 3))
    draws[~np.isfinite(log.pos_w)] = np.nan
    return float(np.nanstd(velocity_from_position(log.time_s, draws)))


def as_json(proof: Proof, seed: int) -> dict[str, Any]:
    """Return the entries that `proof` adds to diagnosis.json."""
    where = proof.where
    changed = where.after is not where.before
    return {
        "kinematics": None if proof.kinematics is None else _kinematics(proof.kinematics),
        "disagreement": {
            "before": in_words(where, where.before),
            "after": in_words(where, where.after) if changed else None,
            "unit": "RMS error over its noise floor",
            "by": {name: _table(where, name) for name in UNITS},
        },
        "actuators": [{**apart._asdict(), "followed": apart.followed} for apart in proof.actuators],
        "black_box": None if proof.contests is None else _contests(proof.contests, seed),
    }


def _kinematics(found: Kinematics) -> dict[str, Any]:
    known = np.isfinite(found.offset_ci)
    return {
        "gyro_bias": {"value": found.bias, "half_width95": found.bias_ci, "unit": "rad/s"},
        "clock_offset": {
            "value": found.offset if known else None,
            "half_width95": found.offset_ci if known else None,
            "unit": "s",
        },
        "velocity_over_path": found.velocity_scale,
    }


def _table(where: Where, condition: str) -> dict[str, Any]:
    edges = where.edges[condition]
    tables = {"before": binned(where, where.before, condition)}
    if where.after is not where.before:
        tables["after"] = binned(where, where.after, condition)
    return {
        "edges": _short(edges),
        "rollouts": tables["before"][1],
        **{
            name: {
                f"{horizon:g} s": {
                    group: _short(by_group(table[h])[:, g]) for g, group in enumerate(GROUPS)
                }
                for h, horizon in enumerate(HORIZONS_S)
            }
            for name, (table, _) in tables.items()
        },
    }


def by_group(table: np.ndarray) -> np.ndarray:
    """Return RMS over the axes of each group (B, 4) of errors (B, 12)."""
    energy = (table**2).reshape(len(table), len(GROUPS), 3)
    seen = np.isfinite(energy)
    count = seen.sum(axis=2)
    total = np.where(seen, energy, 0.0).sum(axis=2)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def _short(values: np.ndarray) -> list[float | None]:
    return [float(f"{v:.{DIGITS}g}") if np.isfinite(v) else None for v in values]


def _contests(found: Contests, seed: int) -> dict[str, Any]:
    return {
        "held_out": _contest(found.held_out, seed),
        "outside": None if found.outside is None else _contest(found.outside, seed),
        "split_m_s": found.split_m_s,
        "seconds": found.seconds,
    }


def _contest(found: Contest, seed: int) -> dict[str, Any]:
    return {
        "judged_on": found.judged_on,
        "stretches": {"fitted": found.fitted, "judged": found.judged},
        "before": _gap(found.before, seed),
        "named": None if found.named is None else _gap(found.named, seed),
        "black_box": _gap(found.black_box, seed),
    }


def _gap(gap: Gap, seed: int) -> dict[str, Any]:
    return {
        "gap": gap.rms,
        "ci95": interval(gap.score, seed),
        "rollouts": {
            f"{horizon:g} s": {group: values[0] for group, values in groups.items()}
            for horizon, groups in gap.table.items()
        },
    }
