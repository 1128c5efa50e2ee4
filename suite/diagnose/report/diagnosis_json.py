"""A diagnosis as the JSON that others read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from suite.diagnose.by_views import ViewResult, ViewsDiagnosis
from suite.diagnose.data.windows import STATE_GROUPS
from suite.diagnose.plans.plan import advice
from suite.diagnose.report.parameters_json import parameters_json, short_name
from suite.diagnose.search.look import NamedEffect
from suite.diagnose.thresholds import THRESHOLDS
from suite.diagnose.verdict.actuators import LAG, RotorLag
from suite.diagnose.verdict.black_box import BlackBoxComparison
from suite.diagnose.verdict.checks import Checks, Kinematics
from suite.diagnose.verdict.diagnosis import Diagnosis
from suite.diagnose.verdict.disturbances import Turbulence
from suite.diagnose.verdict.gap import HEADLINE_S, MEASURE, Gap

SHOWN = 5
"""Shapes of the residual that are listed."""
VIEW_MEASURE = (
    "RMS over the axes of what the model leaves of {about} on held-out flights [{unit}], both "
    "sides smoothed over {width:g} s"
)
SIZES = ("force", "torque", "drift")
"""Of an effect: mean acceleration over half a second [m/s^2], angular acceleration [rad/s^2] and
distance after a second [m], as RMS over the flights."""


def diagnosis_json(found: Diagnosis | ViewsDiagnosis) -> dict[str, Any]:
    """Return what diagnosis.json says of the names and of the gap."""
    named = [name for _, name in found.named]
    shared = {
        "verdict": found.label,
        "effects": effects_json(found),
        "negligible": [
            {"name": one.name, "size": one.size.as_json(), "relevant": False}
            for result in found.results
            for one in result.negligible
        ],
        "relevance": dict(zip(SIZES, found.limits.relevance, strict=True)),
        "separate_with": [advice(n.candidate.name, rival) for n in named for rival in n.rivals],
        "driven_by": found.input_source,
        "seconds": found.seconds,
        "warnings": found.warnings,
    }
    held_out = [short_name(name) for name in found.held_out]
    if isinstance(found, Diagnosis):
        return {
            **shared,
            "gap": {**_whole_gap(found), "held_out": held_out},
            "views": ["whole"],
            "control": found.control
            and {
                "effect": found.control[0],
                "after": found.control[1].rms,
                "after_ci95": found.control[1].ci95(found.seed, found.limits),
            },
            "unexplained": {
                "share": found.verdict.share_left,
                "where": found.verdict.where,
                "shapes": [shape._asdict() for shape in found.residual.shapes[:SHOWN]],
                "coloured": found.residual.coloured,
            },
        }
    main = found.main
    return {
        **shared,
        "gap": {**_views_gap(found), "held_out": held_out},
        "views": [one.view.name for one in found.results if one.names] or [main.view.name],
        "unexplained": {"share": main.gap.share(main.gap.left), "where": _where(found)},
        "reference": list(found.references),
        "headline": headline(found),
    }


def _whole_gap(found: Diagnosis) -> dict[str, Any]:
    before, after, seed = found.before, found.after, found.seed
    return {
        "measure": MEASURE,
        "before": before.rms,
        "after": after.rms,
        "noise_floor": 1.0,
        "model_error": model_error(found),
        "before_ci95": before.ci95(seed, found.limits),
        "after_ci95": after.ci95(seed, found.limits),
        "horizon_s": HEADLINE_S,
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
    }


def _views_gap(found: ViewsDiagnosis) -> dict[str, Any]:
    view, gap = found.main.view, found.main.gap
    about = {"about": view.about, "unit": view.unit, "width": view.width_s}
    return {
        "measure": VIEW_MEASURE.format(**about),
        "before": gap.rms(gap.before),
        "after": gap.rms(gap.after),
        "noise_floor": gap.rms(gap.floor),
        "model_error": None,
        "horizon_s": view.width_s,
        "channels": {one.view.name: _channels(one) for one in found.results},
        "closed": gap.share(gap.closed),
        "explainable": gap.share(gap.explainable),
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


def effects_json(found: Diagnosis | ViewsDiagnosis) -> list[dict[str, Any]]:
    """Return the named effects, one entry for all names of one effect."""
    told = [
        _effect(found, result, [n for n in result.names if n.candidate.name == name])
        for result in found.results
        for name in dict.fromkeys(n.candidate.name for n in result.names)
    ]
    if isinstance(found, Diagnosis):
        return [*told, *_gusts(found.turbulence)]
    return told if found.lag is None else [*told, _lag_effect(found, found.lag)]


def _effect(
    found: Diagnosis | ViewsDiagnosis,
    result: Diagnosis | ViewResult,
    ones: Sequence[NamedEffect],
) -> dict[str, Any]:
    name, theta = ones[0].candidate.name, result.search.estimate.theta
    indices = sorted(i for one in ones for i in one.candidate.indices)
    width, undecided = result.half_width, _undecided(found, ones)
    entry = {
        "name": name,
        "alternatives": sorted({rival for one in ones for rival in one.rivals} - {name}),
        "parameters": parameters_json(found.space, name, indices, theta, width, undecided),
        "gap_removed": min(max(result.removed(ones), 0.0), 1.0),
        "p_value": max(one.p_value for one in ones),
        "size": result.size(ones)[0].as_json(),
        "relevant": True,
    }
    return entry if isinstance(result, Diagnosis) else {**entry, "view": result.view.name}


def _lag_effect(found: ViewsDiagnosis, lag: RotorLag) -> dict[str, Any]:
    (index,) = (i for i, entry in enumerate(found.space.entries) if entry.effect == LAG)
    theta = found.space.array("start")
    theta[index] = lag.time_constant
    return {
        "name": LAG,
        "alternatives": [],
        "parameters": parameters_json(found.space, LAG, [index], theta, {index: lag.half_width}),
        "gap_removed": lag.closed,
        "p_value": lag.p_value,
        "size": None,
        "relevant": True,
        "view": "commands",
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


def _undecided(found: Diagnosis | ViewsDiagnosis, ones: Sequence[NamedEffect]) -> list[int]:
    """Return the places of an effect's other numbers, one at a time, that fit as well."""
    taken = {i for one in ones for i in one.candidate.indices}
    near = found.limits.rival_chi2
    return [
        i
        for i, entry in enumerate(found.space.entries)
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


def headline(found: ViewsDiagnosis) -> str:
    """Return the answer in a sentence."""
    gap, view = found.main.gap, found.main.view
    could = gap.share(gap.explainable)
    late = _late(found)
    if not found.named:
        if found.label == "named":
            return late.strip()
        if found.label == "no_gap":
            what = "has changed" if found.references else "is missing"
            return f"Nothing that the flights agree on {what}."
        swings = f"It {found.swing.words}. " if found.swing else ""
        return (
            f"{swings}No effect that flights can tell explains it; a black box closes "
            f"{100 * could:.0f} % of the variance of the {view.name}.{late}"
        )
    names = " and ".join(
        " or ".join([name.candidate.label, *name.rivals]) for _, name in found.named
    )
    since = " since the reference flights" if found.references else ""
    share = gap.share(gap.closed) / max(could, 1e-9)
    swings = f" The residual {found.swing.words}." if found.swing else ""
    return (
        f"{names}{since}: the {view.name} on held-out flights is {gap.rms(gap.after):.3g} instead "
        f"of {gap.rms(gap.before):.3g} {view.unit} off; of what any model could close of its "
        f"changes within a flight here, {100 * min(share, 1.0):.0f} %.{swings}{late}"
    )


def _late(found: ViewsDiagnosis) -> str:
    """Return what is said of the rotors' lag, "" where it is the vehicle's."""
    if found.lag is None:
        return ""
    lag = found.lag
    return (
        f" {LAG}: the rotors follow their commands with a time constant of "
        f"{lag.time_constant:.3g} s instead of {lag.known:.3g} s."
    )


def _channels(one: ViewResult) -> dict[str, Any]:
    gap = one.gap
    told = {
        "before": gap.before,
        "after": gap.after,
        "noise_floor": gap.floor,
        "repeatability": gap.repeatability,
        "closed": gap.closed,
        "explainable": gap.explainable,
    }
    return {
        "xyz"[axis]: {
            key: float(values[axis]) if np.isfinite(values[axis]) else None
            for key, values in told.items()
        }
        for axis in one.view.axes
    }


def _where(found: ViewsDiagnosis) -> str | None:
    """Return where something is left that a black box closes, in words."""
    if found.label in ("no_gap", "named"):
        return None
    one = max(found.results, key=lambda r: r.gap.share(r.gap.left))
    axis = max(one.view.axes, key=lambda k: float(one.gap.left[k] * one.gap.variance[k]))
    swings = f"{found.swing.words}; " if found.swing else ""
    return (
        f"{swings}{one.view.name} along body {'xyz'[axis]}: a black box closes another "
        f"{100 * max(float(one.gap.left[axis]), 0.0):.0f} % of its variance"
    )
