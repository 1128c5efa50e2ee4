"""What the views of real flights found, as the JSON that others read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from suite.diagnose.by_views import ViewResult, ViewsDiagnosis
from suite.diagnose.plans.plan import advice
from suite.diagnose.report.parameters_json import parameters_json, short_name
from suite.diagnose.search.look import NamedEffect
from suite.diagnose.verdict.actuators import LAG, RotorLag
from suite.diagnose.verdict.view_gap import gap_without

MEASURE = (
    "RMS over the axes of what the model leaves of {about} on held-out flights [{unit}], both "
    "sides smoothed over {width:g} s"
)


def views_json(found: ViewsDiagnosis) -> dict[str, Any]:
    """Return what diagnosis.json says of `found`."""
    main, gap = found.main, found.main.gap
    return {
        "verdict": found.verdict,
        "effects": effects_json(found),
        "negligible": [
            {"name": small.name, "size": small.size.as_json(), "relevant": False}
            for one in found.results
            for small in one.negligible
        ],
        "gap": {
            "measure": MEASURE.format(
                about=main.view.about, unit=main.view.unit, width=main.view.width_s
            ),
            "before": gap.rms(gap.before),
            "after": gap.rms(gap.after),
            "noise_floor": gap.rms(gap.floor),
            "model_error": None,
            "horizon_s": main.view.width_s,
            "held_out": [short_name(name) for name in found.held_out],
            "channels": {one.view.name: _channels(one) for one in found.results},
            "closed": gap.share(gap.closed),
            "explainable": gap.share(gap.explainable),
        },
        "views": [one.view.name for one in found.results if one.names] or [main.view.name],
        "unexplained": {"share": gap.share(gap.left), "where": _where(found)},
        "separate_with": [
            advice(name.candidate.name, rival) for _, name in found.named for rival in name.rivals
        ],
        "driven_by": found.flights.source,
        "reference": list(found.references),
        "headline": headline(found),
        "seconds": found.seconds,
        "warnings": found.warnings,
    }


def headline(found: ViewsDiagnosis) -> str:
    """Return the answer in a sentence."""
    gap, view = found.main.gap, found.main.view
    could = gap.share(gap.explainable)
    late = _late(found)
    if not found.named:
        if found.verdict == "named":
            return late.strip()
        if found.verdict == "no_gap":
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
    swings = f" What is left {found.swing.words}." if found.swing else ""
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


def effects_json(found: ViewsDiagnosis) -> list[dict[str, Any]]:
    """Return the named effects, one entry for all names of one effect."""
    effects = {}
    for result, name in found.named:
        effects.setdefault((result.view.name, name.candidate.name), (result, []))[1].append(name)
    told = [_effect(found, result, names) for result, names in effects.values()]
    return told if found.lag is None else [*told, _lag_effect(found, found.lag)]


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


def _effect(
    found: ViewsDiagnosis, result: ViewResult, names: Sequence[NamedEffect]
) -> dict[str, Any]:
    indices = sorted(i for name in names for i in name.candidate.indices)
    gap = result.gap
    without = gap.rms(gap_without(result.search, result.held, indices))
    whole = gap.rms(gap.before) - gap.rms(gap.floor)
    removed = (without - gap.rms(gap.after)) / max(whole, 1e-9)
    effect = names[0].candidate.name
    theta, width = result.search.estimate.theta, result.half_width
    return {
        "name": effect,
        "alternatives": sorted({rival for name in names for rival in name.rivals} - {effect}),
        "parameters": parameters_json(found.space, effect, indices, theta, width),
        "gap_removed": min(max(removed, 0.0), 1.0),
        "p_value": max(name.p_value for name in names),
        "size": result.size(names)[0].as_json(),
        "relevant": True,
        "view": result.view.name,
    }


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
    if found.verdict in ("no_gap", "named"):
        return None
    one = max(found.results, key=lambda r: r.gap.share(r.gap.left))
    axis = max(one.view.axes, key=lambda k: float(one.gap.left[k] * one.gap.variance[k]))
    swings = f"{found.swing.words}; " if found.swing else ""
    return (
        f"{swings}{one.view.name} along body {'xyz'[axis]}: a black box closes another "
        f"{100 * max(float(one.gap.left[axis]), 0.0):.0f} % of its variance"
    )
