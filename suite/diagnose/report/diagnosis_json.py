"""A diagnosis as the JSON that others read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.diagnose import Diagnosis
from suite.diagnose.estimate.parameters import ParameterSpace
from suite.diagnose.plan import advice
from suite.diagnose.report.summary import answer, short_name
from suite.diagnose.search.evaluation import NamedEffect
from suite.diagnose.sources.source import Finding
from suite.diagnose.verdict.actuators import ActuatorMismatch
from suite.diagnose.verdict.black_box import BlackBoxComparison, BlackBoxComparisons
from suite.diagnose.verdict.gap import Gap

SIZES = ("force", "torque", "drift")
"""Of an effect: mean acceleration over half a second [m/s^2], angular acceleration [rad/s^2] and
distance after a second [m], as RMS over the flights."""


LEAST_SHOWN = 0.001
"""Smaller gaps are printed as less than this, in units of the noise, m/s^2 or rad/s^2."""


def diagnosis_json(found: Diagnosis) -> dict[str, Any]:
    """Return what diagnosis.json has of the names and of the gap."""
    main, control = found.main, found.main.control
    limits = found.limits
    swing = next((one.remaining.swing for one in found.findings if one.remaining.swing), None)
    entries: dict[str, Any] = {
        "verdict": found.label,
        "effects": effects_json(found),
        "negligible": [
            {"name": name, "size": size.as_json(), "relevant": False}
            for one in found.findings
            for name, size in one.negligible
        ],
        "relevance": dict(zip(SIZES, limits.relevance, strict=True)),
        "separate_with": list(
            dict.fromkeys(
                advice(one.candidate.name, rival) for _, one in found.named for rival in one.rivals
            )
        ),
        "driven_by": found.flights.driven_by,
        "seconds": found.seconds,
        "warnings": found.warnings,
        "gap": gap_json(found),
        "views": [one.source.name for one in found.findings if one.names] or [main.source.name],
        "control": control
        and {
            "effect": control[0],
            "after": control[1].rms,
            "after_ci95": control[1].ci95(found.seed, limits),
        },
        "unexplained": {
            "share": found.verdict.share_left,
            "where": found.verdict.where,
            "swing": swing and {"period_s": swing.period_s, "length_m": swing.length_m},
            **main.remaining.details,
        },
        "reference": list(found.references),
    }
    return {"headline": headline(found, entries), **entries}


def gap_json(found: Diagnosis) -> dict[str, Any]:
    """Return the gap of the finding that shows most, and the channels of all."""
    main, seed, limits = found.main, found.seed, found.limits
    return {
        "measure": main.source.measure,
        "before": main.before.rms,
        "after": main.after.rms,
        "noise_floor": main.before.floor,
        "model_error": main.source.model_error(main.search),
        "before_ci95": main.before.ci95(seed, limits),
        "after_ci95": main.after.ci95(seed, limits),
        "horizon_s": main.source.horizon_s,
        "channels": {
            group: {
                channel: {
                    "before": value.error,
                    "after": one.after.channels[group][channel].error,
                    "noise_floor": value.floor,
                    **one.remaining.channels.get(group, {}).get(channel, {}),
                }
                for channel, value in channels.items()
            }
            for one in found.findings
            for group, channels in one.before.channels.items()
        },
        **main.remaining.gap_details,
        "held_out": [short_name(name) for name in found.flights.held_out],
    }


def effects_json(found: Diagnosis) -> list[dict[str, Any]]:
    """Return the named effects, one entry for all names of one effect."""
    searched = [
        _effect(one, name, names)
        for one in found.findings
        for name, names in one.by_effect().items()
    ]
    tested = [
        {
            "name": one.name,
            "alternatives": [],
            "parameters": one.parameters,
            "gap_removed": one.gap_removed,
            "p_value": one.p_value,
            "size": None,
            "relevant": True,
            "view": one.view,
        }
        for one in found.tested
    ]
    return [*searched, *tested]


def _effect(finding: Finding, name: str, ones: Sequence[NamedEffect]) -> dict[str, Any]:
    indices = sorted(i for one in ones for i in one.candidate.indices)
    width, undecided = finding.half_width, _undecided(finding, ones)
    size = finding.sizes.get(name)
    return {
        "name": name,
        "alternatives": sorted({rival for one in ones for rival in one.rivals} - {name}),
        "parameters": parameters_json(
            finding.source.space, name, indices, finding.theta, width, undecided
        ),
        "gap_removed": finding.removed(ones),
        "p_value": max(one.p_value for one in ones),
        "size": size and size.as_json(),
        "relevant": True,
        "view": finding.source.name,
    }


def _undecided(finding: Finding, ones: Sequence[NamedEffect]) -> list[int]:
    """Return the places of an effect's other parameters, one at a time, that fit as well."""
    taken = {i for one in ones for i in one.candidate.indices}
    near = finding.source.limits.rival_chi2
    return [
        i
        for i, entry in enumerate(finding.source.space.entries)
        if entry.effect == ones[0].candidate.name and i not in taken
        and any(one.worse_by.get(f"{entry.effect} {(entry.component or 0) + 1}", np.inf) <= near
                for one in ones)
    ]  # fmt: skip


def parameters_json(
    space: ParameterSpace,
    name: str,
    indices: Sequence[int],
    theta: np.ndarray,
    half_width: Mapping[int, float],
    undecided: Sequence[int] = (),
) -> dict[str, Any]:
    """Return the parameters of the effect `name` as diagnosis.json has them.

    Args:
        space: of the vehicle.
        name: of the effect.
        indices: places of its numbers that were fitted, in order.
        theta: (P,) all numbers.
        half_width: of the 95 % intervals, by place.
        undecided: places of its numbers that could stand in place of a fitted one.
    """

    def one(index: int) -> tuple[float, list[float]]:
        entry = space.entries[index]
        value, width = float(theta[index]), half_width[index]
        return value, [max(value - width, entry.low), min(value + width, entry.high)]

    found: dict[str, Any] = {}
    for parameter in EFFECTS[name].parameters:
        if parameter.one_at_a_time:
            values = [one(i) for i in indices]
            which = [_number(space, i) for i in indices]
            lone = len(which) == 1
            could = [*which, *(_number(space, i) for i in undecided)]
            spans = [[min(could), max(could)]] if lone else [[k, k] for k in which]
            found["index"] = {
                "value": which[0] if lone else which,
                "unit": "1",
                "ci95": spans[0] if lone else spans,
            }
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


def _number(space: ParameterSpace, index: int) -> int:
    return (space.entries[index].component or 0) + 1


def headline(found: Diagnosis, entries: Mapping[str, Any]) -> str:
    """Return the answer in a few sentences; `entries` is the rest of the JSON."""
    main, words = found.main, [answer(entries)]
    if found.named:
        source = main.source
        words.append(
            f"On held-out flights the {source.subject} falls from {_figure(main.before.rms)} to "
            f"{_figure(main.after.rms)} {source.unit}."
        )
    words += [one.words or f"Named: {one.name}." for one in found.tested]
    if found.verdict.where:
        words.append(f"Unexplained: {found.verdict.where}.")
    return " ".join(words)


def _figure(value: float) -> str:
    """Return a gap for people; noise-free logs give some of 1e-10."""
    return f"{value:.3g}" if value >= LEAST_SHOWN else f"less than {LEAST_SHOWN:g}"


def actuators_json(mismatches: Sequence[ActuatorMismatch]) -> list[dict[str, Any]]:
    """Return the entry `actuators`: measured rotor speeds against commanded ones."""
    return [{**one._asdict(), "followed": one.followed} for one in mismatches]


def black_box_json(found: BlackBoxComparisons, seed: int) -> dict[str, Any]:
    """Return the entry `black_box`; `seed` is of the intervals' draws."""
    return {
        "held_out": _comparison(found.held_out, seed),
        "outside": found.outside and _comparison(found.outside, seed),
        "split_m_s": found.split_m_s,
        "seconds": found.seconds,
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
            horizon: {group: value.error for group, value in groups.items()}
            for horizon, groups in gap.channels.items()
        },
    }
