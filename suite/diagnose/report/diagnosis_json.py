"""Converts a diagnosis into the content of diagnosis.json (schema: docs/diagnose.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.diagnose import Diagnosis
from suite.diagnose.estimate.parameters import ParameterSpace, effects_in
from suite.diagnose.plan import advice
from suite.diagnose.report.summary import headline, short_name
from suite.diagnose.search.evaluation import NamedEffect
from suite.diagnose.sources.source import Finding
from suite.diagnose.verdict.gap import EffectSize, remaining_share


def diagnosis_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the entries of diagnosis.json on the named effects and the gap."""
    # The control is a wrong effect, for comparison; a swing is an oscillating force.
    main, control, limits = diagnosis.main, diagnosis.main.control, diagnosis.main.source.limits
    swings = (one.remaining.swing for one in diagnosis.findings)
    swing = next(filter(None, swings), None)
    named = [effect for _, effect in diagnosis.named]
    pairs = [(effect.candidate.name, rival) for effect in named for rival in effect.rivals]
    entries: dict[str, Any] = {
        "verdict": diagnosis.verdict.label,
        "effects": effects_json(diagnosis),
        "negligible": [
            {"name": name, "size": size._asdict(), "relevant": size.relevant(limits)}
            for one in diagnosis.findings
            for name, size in one.negligible
        ],
        "relevance": dict(zip(EffectSize._fields, limits.relevance, strict=True)),
        "visible": main.remaining.visible
        and {"force": main.remaining.visible.force, "torque": main.remaining.visible.torque},
        "separate_with": list(dict.fromkeys(advice(*pair) for pair in pairs)),
        "driven_by": diagnosis.flights.driven_by,
        "seconds": diagnosis.seconds,
        "warnings": diagnosis.warnings,
        "gap": gap_json(diagnosis),
        # Without a name, the verdict rests on all views.
        "views": [one.source.name for one in diagnosis.findings if one.names or not named],
        "control": control
        and {
            "effect": control[0],
            "after": control[1].rms,
            "after_ci95": control[1].ci95(diagnosis.seed),
        },
        "unexplained": {
            "share": remaining_share(main.before, main.after) if named or diagnosis.tested else 1.0,
            "judged": diagnosis.verdict.share_left,
            "where": diagnosis.verdict.where,
            "above_noise": [
                {
                    "view": one.source.name,
                    "error": one.after.rms,
                    "noise_floor": one.after.floor,
                    "unit": one.source.unit,
                    "reason": "that no effect of the catalogue explains"
                    if one.remaining.structured
                    else one.remaining.reason,
                }
                for one in diagnosis.findings
                if one.after.rms > limits.above_noise * one.after.floor
            ],
            "swing": swing and {"period_s": swing.period_s, "length_m": swing.length_m},
            **main.remaining.details,
        },
        "reference": list(diagnosis.flights.references),
        "not_examined": not_examined(diagnosis),
    }
    return {"headline": headline(entries), **entries}


def not_examined(diagnosis: Diagnosis) -> list[str]:
    """Return the untested parts of the dynamics: `force`, `torque`, `rate loop`.

    The last is tested if effects that need commands as the model's input are candidates.
    """
    views = {one.source.name for one in diagnosis.findings}
    names = [candidate.name for one in diagnosis.findings for candidate in one.source.candidates]
    tried = {effect for name in names for effect in effects_in(name)}
    parts = [] if "whole" in views else [name for name in ("force", "torque") if name not in views]
    by_command = any("command" in EFFECTS[name].needs for name in tried if name in EFFECTS)
    return [*parts, *([] if by_command else ["rate loop"])]


def gap_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the gap of the main finding, and the channels of all findings."""
    main = diagnosis.main
    return {
        "measure": main.source.measure,
        "of": main.source.subject,
        "unit": main.source.unit,
        "before": main.before.rms,
        "after": main.after.rms,
        "noise_floor": main.before.floor,
        "offset": {
            one.source.name: {
                "before": one.before.offset,
                "after": one.after.offset,
                "unit": one.source.unit,
            }
            for one in diagnosis.findings
            if one.before.offset > 0.0
        },
        "model_error": main.source.model_error(main.search),
        "before_ci95": main.before.ci95(diagnosis.seed),
        "after_ci95": main.after.ci95(diagnosis.seed),
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
            for one in diagnosis.findings
            for group, channels in one.before.channels.items()
        },
        **main.remaining.gap_details,
        "held_out": [short_name(name) for name in dict.fromkeys(diagnosis.flights.held_out)],
    }


def effects_json(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return an entry for each named effect (one for several motors), separate tests last."""
    searched = [
        _effect(
            finding,
            name,
            [named for named in finding.names if named.candidate.name == name],
            diagnosis.vehicle.rotors.position,
        )
        for finding in diagnosis.findings
        for name in dict.fromkeys(named.candidate.name for named in finding.names)
    ]
    keys = ("name", "parameters", "gap_removed", "p_value", "view")
    tested = [
        {
            **{key: getattr(effect, key) for key in keys},
            "alternatives": [],
            "size": None,
            "relevant": True,
        }
        for effect in diagnosis.tested
    ]
    return [*searched, *tested]


def _effect(
    finding: Finding, name: str, names: Sequence[NamedEffect], rotors_b: Sequence[Sequence[float]]
) -> dict[str, Any]:
    """Return the entry of the effect `name`; `names` are its named effects, one for each motor.

    `rotors_b` are the positions of the rotors in body axes [m].
    """
    indices = sorted(index for named in names for index in named.candidate.indices)
    space, width, size = finding.source.space, finding.half_width, finding.sizes.get(name)
    limits, names_small = finding.source.limits, finding.source.names_small
    # The same effect of another motor may fit about as well: the flights do not decide which.
    rises = [rise for named in names for rise in named.worse_by.items()]
    close = {label for label, rise in rises if rise <= limits.rival_chi2}
    undecided = [
        index
        for index, entry in enumerate(space.entries)
        if entry.effect == name
        and index not in indices
        and f"{name} {_motor_number(space, index)}" in close
    ]
    parameters = parameters_json(space, name, indices, finding.theta, width, undecided)
    if motors := parameters.get("index"):  # autopilots number the rotors in other orders
        motors["place"] = [rotor_place(rotors_b[n - 1]) for n in np.atleast_1d(motors["value"])]
    return {
        "name": name,
        "alternatives": sorted({rival for named in names for rival in named.rivals} - {name}),
        "parameters": parameters,
        "gap_removed": finding.removed(names),
        "p_value": max(named.p_value for named in names),
        "size": size and size._asdict(),
        # Effects of irrelevant size were left out, unless a change is searched for.
        "relevant": not (names_small and size) or size.relevant(limits),
        "view": finding.source.name,
    }


def rotor_place(position_b: Sequence[float]) -> str:
    """Return where the rotor at `position_b` (3,) in body axes [m] is, such as "front right"."""
    x, y = position_b[:2]
    least = 0.25 * float(np.hypot(x, y))
    words = {("front" if x > 0 else "rear"): abs(x), ("left" if y > 0 else "right"): abs(y)}
    return " ".join(word for word, distance in words.items() if distance > least)


def parameters_json(
    space: ParameterSpace,
    name: str,
    indices: Sequence[int],
    theta: np.ndarray,
    half_width: Mapping[int, float],
    undecided: Sequence[int] = (),
) -> dict[str, Any]:
    """Return the parameters of the effect `name` in `theta` (P,) as in diagnosis.json.

    `half_width` has those of the 95 % intervals by index. For an effect of one motor, `undecided`
    are parameters for other motors that fit as well.
    """

    def value_and_interval(index: int) -> tuple[float, list[float] | None]:
        """Return the value of a parameter and its interval, within the parameter's bounds.

        A parameter that was not fitted has its value in the vehicle file, and no interval.
        """
        entry = space.entries[index]
        value, width = float(theta[index]), half_width.get(index)
        if width is None:
            return value, None
        return value, [max(value - width, entry.low), min(value + width, entry.high)]

    entries: dict[str, Any] = {}
    fitted = {(space.entries[i].parameter, space.entries[i].component): i for i in indices}
    for parameter in EFFECTS[name].parameters:
        # An effect of single motors: the motors' numbers, and a value for each, also for those
        # that the vehicle file has. If only one motor was named, the interval of its number covers
        # the other motors that fit as well.
        if parameter.one_at_a_time:
            of_file = (
                index
                for index, entry in enumerate(space.entries)
                if entry.effect == name and entry.start != parameter.neutral
            )
            present = sorted({*indices, *of_file})
            values, spans = zip(*map(value_and_interval, present), strict=True)
            file = [space.entries[index].start for index in present]
            motors = [_motor_number(space, index) for index in present]
            is_single, ranges = len(present) == 1, [[motor, motor] for motor in motors]
            if len(indices) == 1:
                possible = [_motor_number(space, index) for index in (*indices, *undecided)]
                ranges[present.index(indices[0])] = [min(possible), max(possible)]
            for key, unit, columns in (
                ("index", "1", (motors, ranges)),
                (parameter.name, parameter.unit, (values, spans)),
            ):
                value, ci95 = (column[0] if is_single else list(column) for column in columns)
                entries[key] = {"value": value, "unit": unit, "ci95": ci95}
            entries[parameter.name]["file"] = file[0] if is_single else file
            continue
        # A vector has None for components that were not fitted.
        keys = [(parameter.name, k) for k in range(parameter.size)] or [(parameter.name, None)]
        if not any(key in fitted for key in keys):
            continue
        parts = [
            (*value_and_interval(fitted[k]), space.entries[fitted[k]].start)
            if k in fitted
            else (None, None, None)
            for k in keys
        ]
        value, ci95, file = map(list, zip(*parts, strict=True)) if parameter.size else parts[0]
        unit = parameter.unit
        entries[parameter.name] = {"value": value, "unit": unit, "ci95": ci95, "file": file}
    return entries


def _motor_number(space: ParameterSpace, index: int) -> int:
    """Return the number (from 1) of the motor to which the parameter at `index` belongs."""
    return (space.entries[index].component or 0) + 1
