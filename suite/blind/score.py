"""Scores of diagnoses: named effects, false names and intervals, compared with the answers."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from eval.judging.statistics import wilson
from eval.quadrotor.vehicle_file import load_vehicle
from suite.blind.cases import MULTIPLES, ROTORPY
from suite.blind.make import load_manifest, open_answers, simulator_of
from suite.blind.rotorpy_flight import damping_of_hubs, is_of_hubs
from suite.blind.run import FAILED, TIMED
from suite.diagnose.estimate.parameters import effects_in
from tracks.common.files import write_json, write_text
from tracks.common.grid import markdown, table
from tracks.common.provenance import stamp

SCHEMA = 1
GAP_LIMIT = 1.1
"""Limit of the ratio of the remaining gap to the noise floor."""


@dataclass(frozen=True)
class Verdict:
    """The score of one case."""

    case: str
    kind: str
    hidden: tuple[str, ...]
    multiple: float
    verdict: str
    """Verdict of the diagnosis; `failed` if there is none."""
    named: tuple[tuple[str, ...], ...]
    """Named effects, each with its alternatives."""
    found: bool
    """Whether every hidden effect is named, with the right alternatives."""
    extra: int
    """Number of named effects that are false, with all alternatives."""
    covered: tuple[bool, ...]
    """Whether the interval of each component contains the true value."""
    gap_ratio: float | None
    """Gap after over noise floor."""
    seconds: float | None
    brought: int = 0
    """Number of named effects that are physics of the simulator itself, by name and size."""

    @property
    def exact(self) -> bool:
        """Whether all hidden effects are named, and nothing else."""
        return self.found and self.extra == 0


@dataclass(frozen=True)
class Share:
    """A line of the table: a count of cases, with a 95 % Wilson interval of the share."""

    what: str
    count: int
    of: int
    low: float
    high: float
    wanted: str
    """The goal."""


def score_case(
    name: str,
    answer: Mapping[str, Any],
    diagnosis: Mapping[str, Any] | None,
    seconds: float | None,
    hubs: np.ndarray | None = None,
) -> Verdict:
    """Return the score of `diagnosis` (None if it failed) for `answer`.

    `hubs` (3,) is the angular damping by moving hubs in the simulator [1/s], if it has one.
    """
    truths: Sequence[Mapping[str, Any]] = answer["effects"]
    hidden = [answer["outside"]] if answer.get("outside") else truths
    effects = [] if diagnosis is None else diagnosis.get("effects", [])
    sets = tuple((e["name"], *e.get("alternatives", [])) for e in effects)
    brought = [hubs is not None and is_of_hubs(e, hubs) for e in effects]
    pairs = _matched(truths, sets)
    right = [_is_right(truths[t], sets[e]) for t, e in pairs.items()]
    names, used = {truth["name"] for truth in truths}, set(pairs.values())
    # False names, and true names that another set already has.
    extra = [
        e not in used if names & set(group) else not brought[e] for e, group in enumerate(sets)
    ]
    covered = [
        inside
        for t, e in pairs.items()
        if sets[e][0] == truths[t]["name"]
        for inside in _covered(truths[t]["parameters"], effects[e].get("parameters", {}))
    ]
    gap = (diagnosis or {}).get("gap") or {}
    floor, after = gap.get("noise_floor"), gap.get("after")
    return Verdict(
        name,
        answer["kind"],
        tuple(each["name"] for each in hidden),
        float(max((each["multiple"] for each in hidden), default=0.0)),
        "failed" if diagnosis is None else str(diagnosis["verdict"]),
        sets,
        bool(truths) and len(right) == len(truths) and all(right),
        sum(extra),
        tuple(covered),
        after / floor if floor and after is not None and sets else None,
        seconds,
        sum(brought),
    )


def score_set(out: Path, results: Path | None = None) -> list[Verdict]:
    """Return the scores of all diagnosed cases of the set in `out`.

    Raises:
        ValueError: if a file of the set has changed, or no case was diagnosed.
    """
    folder = results or out / "results"
    scored, in_rotorpy = [], simulator_of(out) == ROTORPY
    for name, answer in open_answers(out).items():
        if not any((folder / name / mark).is_file() for mark in (TIMED, FAILED)):
            continue
        hubs = None
        if in_rotorpy:
            vehicle = load_vehicle(str(out / "cases" / name / "vehicle.toml"))
            hubs = damping_of_hubs(answer["effects"], vehicle)
        diagnosis = _read(folder / name / "diagnosis.json")
        timing = _read(folder / name / TIMED)
        # Without its time a diagnosis did not end normally.
        good = diagnosis if timing else None
        seconds = timing["seconds"] if timing else None
        scored.append(score_case(name, answer, good, seconds, hubs))
    if not scored:
        raise ValueError(f"{folder}: no case was diagnosed yet; do that with `suite blind run`")
    return scored


def not_run(out: Path, verdicts: Sequence[Verdict]) -> list[str]:
    """Return the cases of the set in `out` without a score."""
    scored = {v.case for v in verdicts}
    return [name for name in load_manifest(out).cases if name not in scored]


def shares(verdicts: Sequence[Verdict]) -> list[Share]:
    """Return the lines of the table with shares, without empty ones."""

    def of(kind: str) -> list[Verdict]:
        return [v for v in verdicts if v.kind == kind]

    single, null, pair = of("single"), of("null"), of("pair")
    # A failed diagnosis names nothing, which must not count as correct.
    ended = [v for v in verdicts if v.verdict != "failed"]
    by_chance = {name for name, effect in EFFECTS.items() if effect.random}
    ratios = [v.gap_ratio for v in verdicts if v.found and not by_chance & set(v.hidden)]
    lines = [
        ("single effects: named, nothing else", "95 %", [v.exact for v in single]),
        *(
            (
                f"  of these at {times:g} times detectable",
                "",
                [v.exact for v in single if _near(v.multiple, MULTIPLES) == times],
            )
            for times in MULTIPLES
        ),
        _without_hubs(single),
        ("single effects: named, others perhaps too", "", [v.found for v in single]),
        ("single effects: verdict `named`", "", [v.verdict == "named" for v in single]),
        ("nulls: something named", "at most 2 of 100",
         [bool(v.named) for v in ended if v.kind == "null"]),
        ("nulls: verdict `no_gap`", "", [v.verdict == "no_gap" for v in null]),
        ("outside the catalogue: `unknown` or `partly`", "85 %", [*map(_expected, of("outside"))]),
        ("pairs: both named", "80 %", [v.found for v in pair]),
        ("pairs: both named, nothing else", "", [v.exact for v in pair]),
        _without_hubs(pair),
        ("inseparable: the right set", "95 %", [v.exact for v in of("blurred")]),
        ("the same with separating flights", "95 %", [v.exact for v in of("separated")]),
        ("cases with a spurious extra name", "", [v.extra > 0 for v in ended if v.hidden]),
        ("95 % intervals that contain the true value", "90-98 %",
         [x for v in verdicts for x in v.covered]),
        (f"gap after within {GAP_LIMIT} of the noise floor, where named", "all",
         [ratio <= GAP_LIMIT for ratio in ratios if ratio is not None]),
        ("diagnosis failed", "none", [v.verdict == "failed" for v in verdicts]),
    ]  # fmt: skip
    found = []
    for what, wanted, flags in lines:
        if flags:
            share = wilson(sum(flags), len(flags))
            found.append(Share(what, sum(flags), len(flags), share.low, share.high, wanted))
    return found


def report(out: Path, verdicts: Sequence[Verdict]) -> str:
    """Write `table.md` and `table.json` into `out` and return the table (Markdown)."""
    counted = shares(verdicts)
    lines = [
        [s.what, f"{s.count} of {s.of} ({100 * s.count / s.of:.0f} %)",
         f"{100 * s.low:.0f}-{100 * s.high:.0f} %", s.wanted]
        for s in counted
    ]  # fmt: skip
    times = [v.seconds for v in verdicts if v.seconds is not None]
    ratios = [v.gap_ratio for v in verdicts if v.found and v.gap_ratio is not None]
    if times:
        lines.append(["seconds a case, median", f"{median(times):.3g} s", "", ""])
    if ratios:
        what = "gap after over noise floor where named, median"
        lines.append([what, f"{median(ratios):.3g}", "", ""])
    wrong = [
        [v.case, v.kind, ", ".join(v.hidden) or "–", f"{v.multiple:.1f}", v.verdict,
         "; ".join(" or ".join(group) for group in v.named) or "–"]
        for v in verdicts
        if not _expected(v)
    ]  # fmt: skip
    heads = ["case", "kind", "hidden", "x detectable", "verdict", "named"]
    title = f"{len(wrong)} of {len(verdicts)} cases are not as expected:"
    waiting, failed = not_run(out, verdicts), load_manifest(out).failed
    count = len(waiting) + len(verdicts)
    notes = [
        waiting and f"Not run yet, so in none of these numbers: {len(waiting)} of {count} cases.",
        failed and f"Not made: {', '.join(failed)}.",
    ]
    text = "\n".join(
        [
            markdown(table(["", "", "95 % interval", "wanted"], lines)),
            markdown(table(heads, wrong, title)),
            *(f"{note}\n" for note in notes if note),
        ]
    )
    write_text(out / "table.md", text)
    summary = {
        **stamp(SCHEMA, None),
        "shares": counted,
        "seconds_median": median(times) if times else None,
        "not_run": waiting,
        "cases": verdicts,
    }
    write_json(out / "table.json", summary)
    return text


def _without_hubs(verdicts: Sequence[Verdict]) -> tuple[str, str, list[bool]]:
    """Return the line on correct cases if a named damping by moving hubs counts as false."""
    brought = any(v.brought for v in verdicts)
    flags = [v.exact and not v.brought for v in verdicts if brought]
    kind = verdicts[0].kind if verdicts else ""
    return f"  {kind}: with no damping by moving hubs in addition", "", flags


def _matched(
    truths: Sequence[Mapping[str, Any]], sets: Sequence[tuple[str, ...]]
) -> dict[int, int]:
    """Return for each true effect the index of the named effect, each used once.

    First names have priority over alternatives, for sets with a common name.
    """
    pairs: dict[int, int] = {}
    for first_only in (True, False):
        for t, truth in enumerate(truths):
            for e, group in enumerate(sets):
                names = group[:1] if first_only else group
                if t not in pairs and e not in pairs.values() and truth["name"] in names:
                    pairs[t] = e
    return pairs


def _is_right(truth: Mapping[str, Any], group: tuple[str, ...]) -> bool:
    # Hypotheses of several effects are ignored: the oracle has only single effects.
    others = {name for name in group if len(effects_in(name)) == 1} - {truth["name"]}
    return set(truth["required"]) <= others <= set(truth["allowed"]) | set(truth["required"])


def _covered(truth: Mapping[str, Any], found: Mapping[str, Any]) -> Iterator[bool]:
    for name, value in truth.items():
        interval = (found.get(name) or {}).get("ci95")
        if interval is None:
            continue
        values = value if isinstance(value, list) else [value]
        intervals = interval if isinstance(value, list) else [interval]
        if "index" in found:
            # Components (from 1) that are listed alone, such as one weak rotor.
            index = found["index"]["value"]
            index, intervals = (
                (index, interval) if isinstance(index, list) else ([index], [interval])
            )
            values = [values[int(number) - 1] for number in index]
        for one, span in zip(values, intervals, strict=False):
            if one is not None and span is not None and None not in span:
                yield bool(span[0] <= one <= span[1])


def _expected(v: Verdict) -> bool:
    if v.kind == "null":
        return v.verdict == "no_gap"
    if v.kind == "outside":
        return v.verdict in ("unknown", "partly")
    return v.exact


def _near(value: float, steps: Sequence[float]) -> float:
    return min(steps, key=lambda step: abs(step - value))


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
