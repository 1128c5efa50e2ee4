"""A diagnosis as the JSON that others read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.diagnose import Diagnosis
from suite.diagnose.fit.search import Named
from suite.diagnose.fit.turbulence import Turbulence
from suite.diagnose.verdict.gap import HEADLINE_S, MEASURE, interval
from suite.diagnose.verdict.separate import advice

SHOWN = 5
"""Shapes of the rest that are listed."""


def answer(diagnosis: Diagnosis, seed: int = 0) -> dict[str, Any]:
    """Return the contents of diagnosis.json; `seed` is that of the intervals' draws."""
    named = diagnosis.finding.named
    before, after = diagnosis.before, diagnosis.after
    return {
        "verdict": diagnosis.verdict,
        "effects": [
            _effect(diagnosis, name) for name in dict.fromkeys(n.candidate.name for n in named)
        ]
        + _gusts(diagnosis.turbulence),  # fmt: skip
        "gap": {
            "measure": MEASURE,
            "before": before.rms,
            "after": after.rms,
            "noise_floor": 1.0,
            "before_ci95": interval(before.score, seed),
            "after_ci95": interval(after.score, seed),
            "horizon_s": HEADLINE_S,
            "held_out": diagnosis.held_out,
            "channels": {
                f"{horizon:g} s": {
                    group: {
                        "before": table[group][0],
                        "after": after.table[horizon][group][0],
                        "noise_floor": table[group][1],
                    }
                    for group in table
                }
                for horizon, table in before.table.items()
            },
        },
        "control": None
        if diagnosis.control is None
        else {
            "effect": diagnosis.control[0],
            "after": diagnosis.control[1].rms,
            "after_ci95": interval(diagnosis.control[1].score, seed),
        },  # fmt: skip
        "unexplained": {
            "share": diagnosis.share_left,
            "where": diagnosis.where,
            "shapes": [shape._asdict() for shape in diagnosis.rest.shapes[:SHOWN]],
            "coloured": diagnosis.rest.coloured,
        },
        "separate_with": [advice(n.candidate.name, rival) for n in named for rival in n.rivals],
        "driven_by": diagnosis.driven_by,
        "seconds": diagnosis.seconds,
        "warnings": diagnosis.warnings,
    }


def _effect(diagnosis: Diagnosis, name: str) -> dict[str, Any]:
    ones = [n for n in diagnosis.finding.named if n.candidate.name == name]
    before, after = diagnosis.before.rms, diagnosis.after.rms
    without = [diagnosis.without[n.candidate.label].rms for n in ones]
    removed = (max(without) - after) / max(before - 1.0, 1e-9)
    return {
        "name": name,
        "alternatives": sorted({rival for n in ones for rival in n.rivals} - {name}),
        "parameters": _parameters(diagnosis, name, ones),
        "gap_removed": min(max(removed, 0.0), 1.0),
        "p_value": max(n.p_value for n in ones),
    }


def _gusts(found: Turbulence | None) -> list[dict[str, Any]]:
    """Return the entry of random wind; no rollout repeats it, so that it takes no gap away."""
    if found is None:
        return []
    return [
        {
            "name": found.effect,
            "alternatives": [],
            "parameters": {
                "intensity": {
                    "value": found.intensity,
                    "unit": "m/s",
                    "ci95": list(found.intensity_ci95),
                },
                "length": {"value": found.length, "unit": "m", "ci95": list(found.length_ci95)},
            },
            "gap_removed": None,
            "p_value": float(np.exp(-found.ratio)),
        }
    ]


def _parameters(diagnosis: Diagnosis, name: str, ones: list[Named]) -> dict[str, Any]:
    space, finding = diagnosis.model.space, diagnosis.finding
    place = {index: k for k, index in enumerate(finding.indices)}
    indices = sorted(i for n in ones for i in n.candidate.indices)

    def one(index: int) -> tuple[float, list[float]]:
        entry = space.entries[index]
        value, width = float(finding.state.theta[index]), float(diagnosis.widths[place[index]])
        return value, [max(value - width, entry.low), min(value + width, entry.high)]

    found: dict[str, Any] = {}
    for parameter in EFFECTS[name].parameters:
        if parameter.one_at_a_time:
            values = [one(i) for i in indices]
            which = [(space.entries[i].component or 0) + 1 for i in indices]
            lone = len(which) == 1
            found["index"] = {"value": which[0] if lone else which, "unit": "1", "ci95": None}
            found[parameter.name] = {
                "value": values[0][0] if lone else [v for v, _ in values],
                "unit": parameter.unit,
                "ci95": values[0][1] if lone else [c for _, c in values],
            }
            continue
        at = {space.entries[i].component: i for i in indices
              if space.entries[i].parameter == parameter.name}  # fmt: skip
        if not at:
            continue
        if parameter.size:
            parts = [one(at[k]) if k in at else (None, None) for k in range(parameter.size)]
            value, ci = [v for v, _ in parts], [c for _, c in parts]
        else:
            value, ci = one(at[None])
        found[parameter.name] = {"value": value, "unit": parameter.unit, "ci95": ci}
    return found


def components(parameters: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield label, value and interval of every component, None where there is none."""
    for name, entry in parameters.items():
        value, span, unit = entry["value"], entry["ci95"], entry["unit"]
        if not isinstance(value, list):
            yield f"{name} [{unit}]", value, span
            continue
        for k, one in enumerate(value):
            yield f"{name} {k + 1} [{unit}]", one, span[k] if span else None
