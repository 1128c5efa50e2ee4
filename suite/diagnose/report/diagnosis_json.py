"""A diagnosis as the JSON that others read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from suite.diagnose.data.windows import STATE_GROUPS
from suite.diagnose.plans.plan import advice
from suite.diagnose.report.parameters_json import parameters_json, short_name
from suite.diagnose.search.look import NamedEffect
from suite.diagnose.thresholds import THRESHOLDS
from suite.diagnose.verdict.black_box import BlackBoxComparison
from suite.diagnose.verdict.checks import Checks, Kinematics
from suite.diagnose.verdict.diagnosis import Diagnosis
from suite.diagnose.verdict.disturbances import Turbulence
from suite.diagnose.verdict.gap import HEADLINE_S, MEASURE, Gap

SHOWN = 5
"""Shapes of the residual that are listed."""
SIZES = ("force", "torque", "drift")
"""Of an effect: mean acceleration over half a second [m/s^2], angular acceleration [rad/s^2] and
distance after a second [m], as RMS over the flights."""


def diagnosis_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return what diagnosis.json says of the names and of the gap."""
    named, seed = diagnosis.search.named, diagnosis.seed
    before, after, control = diagnosis.before, diagnosis.after, diagnosis.control
    names = dict.fromkeys(one.candidate.name for one in named)
    effects = [_effect(diagnosis, name) for name in names]
    return {
        "verdict": diagnosis.verdict.label,
        "effects": effects + _gusts(diagnosis.turbulence),
        "negligible": [
            {"name": one.name, "size": one.size.as_json(), "relevant": False}
            for one in diagnosis.negligible
        ],
        "relevance": dict(zip(SIZES, diagnosis.limits.relevance, strict=True)),
        "gap": {
            "measure": MEASURE,
            "before": before.rms,
            "after": after.rms,
            "noise_floor": 1.0,
            "model_error": model_error(diagnosis),
            "before_ci95": before.ci95(seed, diagnosis.limits),
            "after_ci95": after.ci95(seed, diagnosis.limits),
            "horizon_s": HEADLINE_S,
            "held_out": [short_name(name) for name in diagnosis.held_out],
            "channels": {
                f"{horizon:g} s": {
                    group: {
                        "before": error,
                        "after": after.table[horizon][group][0],
                        "noise_floor": floor,
                    }
                    for group, (error, floor) in table.items()
                }
                for horizon, table in before.table.items()
            },
        },
        "views": ["whole"],
        "control": control
        and {
            "effect": control[0],
            "after": control[1].rms,
            "after_ci95": control[1].ci95(seed, diagnosis.limits),
        },
        "unexplained": {
            "share": diagnosis.verdict.share_left,
            "where": diagnosis.verdict.where,
            "shapes": [shape._asdict() for shape in diagnosis.residual.shapes[:SHOWN]],
            "coloured": diagnosis.residual.coloured,
        },
        "separate_with": [advice(n.candidate.name, rival) for n in named for rival in n.rivals],
        "driven_by": diagnosis.input_source,
        "seconds": diagnosis.seconds,
        "warnings": diagnosis.warnings,
    }


def checks_json(checks: Checks, seed: int) -> dict[str, Any]:
    """Return the entries that `checks` add to diagnosis.json; `seed` is of the intervals' draws."""
    black_box = checks.black_box
    return {
        "kinematics": checks.kinematics and _kinematics(checks.kinematics),
        "actuators": [{**one._asdict(), "followed": one.followed} for one in checks.actuators],
        "black_box": black_box
        and {
            "held_out": _comparison(black_box.held_out, seed),
            "outside": black_box.outside and _comparison(black_box.outside, seed),
            "split_m_s": black_box.split_m_s,
            "seconds": black_box.seconds,
        },
    }


def _effect(diagnosis: Diagnosis, name: str) -> dict[str, Any]:
    ones = [n for n in diagnosis.search.named if n.candidate.name == name]
    before, after = diagnosis.before.rms, diagnosis.after.rms
    without = [diagnosis.without[n.candidate.label].rms for n in ones]
    removed = (max(without) - after) / max(before - 1.0, 1e-9)
    return {
        "name": name,
        "alternatives": sorted({rival for n in ones for rival in n.rivals} - {name}),
        "parameters": parameters_json(
            diagnosis.model.space,
            name,
            sorted(i for n in ones for i in n.candidate.indices),
            diagnosis.search.estimate.theta,
            dict(zip(diagnosis.search.indices, diagnosis.half_widths.tolist(), strict=True)),
            _undecided(diagnosis, ones),
        ),
        "gap_removed": min(max(removed, 0.0), 1.0),
        "p_value": max(n.p_value for n in ones),
        "size": diagnosis.sizes[name].as_json(),
        "relevant": True,
    }


def model_error(diagnosis: Diagnosis) -> float:
    """Return the share of the noise floor that is the model's own numerical error, 0 to 1.

    It is that of the group of channels in which it is largest.
    """
    limits, sigma = diagnosis.limits, diagnosis.sigma
    least = np.array(limits.least_noise)[: len(STATE_GROUPS)]
    raised = least > np.array(THRESHOLDS.least_noise)[: len(STATE_GROUPS)]
    whole = np.sqrt(np.nan_to_num(sigma[:12].reshape(-1, 3) ** 2).mean(axis=1))
    share = np.where(raised, least / np.maximum(whole, 1e-12), 0.0)
    return float(min(share.max(), 1.0))


def _undecided(diagnosis: Diagnosis, ones: Sequence[NamedEffect]) -> list[int]:
    """Return the places of an effect's other numbers, one at a time, that fit as well."""
    taken = {i for one in ones for i in one.candidate.indices}
    near = diagnosis.limits.rival_chi2
    return [
        i
        for i, entry in enumerate(diagnosis.model.space.entries)
        if entry.effect == ones[0].candidate.name and i not in taken
        and any(one.worse_by.get(f"{entry.effect} {(entry.component or 0) + 1}", np.inf) <= near
                for one in ones)
    ]  # fmt: skip


def _gusts(found: Turbulence | None) -> list[dict[str, Any]]:
    """Return the entry of random wind; no rollout repeats it, so that it takes no gap away."""
    if found is None:
        return []
    intensity, length = list(found.intensity_ci95), list(found.length_ci95)
    return [
        {
            "name": found.effect,
            "alternatives": [],
            "parameters": {
                "intensity": {"value": found.intensity, "unit": "m/s", "ci95": intensity},
                "length": {"value": found.length, "unit": "m", "ci95": length},
            },
            "gap_removed": None,
            "p_value": float(np.exp(-found.ratio)),
            "size": None,
            "relevant": True,
        }
    ]


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


def _comparison(found: BlackBoxComparison, seed: int) -> dict[str, Any]:
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
        "ci95": gap.ci95(seed),
        "rollouts": {
            f"{horizon:g} s": {group: values[0] for group, values in groups.items()}
            for horizon, groups in gap.table.items()
        },
    }
