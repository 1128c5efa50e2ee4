"""Score the diagnoses of blind cases: compare named effects and intervals with the answers.

The gap is the rollout error on held-out flights; its noise floor is the error that measurement
noise alone gives.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from eval.judging.statistics import wilson_by_group
from eval.quadrotor.vehicle_file import load_vehicle
from suite.blind.cases import MULTIPLES, ROTORPY
from suite.blind.make import RESULTS, load_manifest, open_answers, simulator_of
from suite.blind.rotorpy_flight import hub_damping, is_hub_damping
from suite.blind.run import FAILED, TIMED
from suite.diagnose.estimate.parameters import effects_in
from tracks.common.files import write_json, write_text
from tracks.common.grid import markdown, table
from tracks.common.provenance import stamp, stamp_text

SCHEMA = 1
"""Version of table.json."""
GAP_LIMIT = 1.1
"""Goal for the gap with the named effects, divided by the noise floor: at most this."""
COVERED = "95 % intervals that contain the true value"
"""Description of the row that counts intervals; the other rows count cases."""


@dataclass(frozen=True)
class Verdict:
    """The score of one case."""

    case: str
    kind: str
    """Kind of the case, such as `single`; see `suite.blind.cases.Case`."""
    hidden: tuple[str, ...]
    multiple: float
    """Largest strength of the hidden effects, as a multiple of the just detectable strength."""
    verdict: str
    """Verdict of the diagnosis, such as `named`; `failed` if the diagnosis failed."""
    named: tuple[tuple[str, ...], ...]
    """Named effects: for each its name, then the names of its alternatives."""
    found: bool
    """Whether every hidden effect is named, with the right alternatives."""
    extra: int
    """Number of named effects that are false: neither the name nor an alternative is true."""
    covered: tuple[bool, ...]
    """For each component of each correctly named effect: whether the 95 % interval of the diagnosis
    contains the true value."""
    gap_ratio: float | None
    """Gap with the named effects, divided by the noise floor; None if no effect is named."""
    seconds: float | None
    """Time of the diagnosis [s]."""
    brought: int = 0
    """Number of named effects that are not hidden, but true of the simulator: RotorPy has a damping
    by moving hubs, which a diagnosis may name (see `suite.blind.rotorpy_flight`)."""

    @property
    def exact(self) -> bool:
        """Whether all hidden effects are named, and nothing else."""
        return self.found and self.extra == 0


@dataclass(frozen=True)
class Share:
    """A row of the table: `count` of `of` cases, with a 95 % Wilson interval of this share.

    The row `COVERED` counts intervals of the diagnoses; its Wilson interval is over cases.
    """

    what: str
    """Description of what is counted."""
    count: int
    of: int
    """Largest possible count, such as the number of nulls."""
    low: float
    high: float
    wanted: str
    """The goal, as text; "" without a goal."""


def score_case(
    name: str,
    answer: Mapping[str, Any],
    diagnosis: Mapping[str, Any] | None,
    seconds: float | None,
    hubs: np.ndarray | None = None,
) -> Verdict:
    """Return the score of a diagnosis.

    Args:
        name: name of the case.
        answer: contents of its answer.
        diagnosis: contents of `diagnosis.json`; None if the diagnosis failed.
        seconds: time of the diagnosis [s]; None if it failed.
        hubs: (3,) angular damping about the body axes that the simulator has by itself, because the
            hubs of the rotors move through the air [1/s]; None if it has none.
    """
    truths: Sequence[Mapping[str, Any]] = answer["effects"]
    hidden = [answer["outside"]] if answer.get("outside") else truths
    effects = [] if diagnosis is None else diagnosis.get("effects", [])
    # A named effect with its alternatives is a set of names.
    name_sets = tuple((e["name"], *e.get("alternatives", [])) for e in effects)
    is_brought = [hubs is not None and is_hub_damping(e, hubs) for e in effects]
    # Which set names which true effect.
    pairs = _match(truths, name_sets)
    is_right = [_is_right(truths[t], name_sets[e]) for t, e in pairs.items()]
    true_names, matched = {truth["name"] for truth in truths}, set(pairs.values())
    # A set is extra if it has no true name, except for a damping by moving hubs. A set with a true
    # name is extra if another set names that effect already.
    is_extra = [
        e not in matched if true_names & set(group) else not is_brought[e]
        for e, group in enumerate(name_sets)
    ]
    covered = [
        inside
        for t, e in pairs.items()
        if name_sets[e][0] == truths[t]["name"]
        for inside in _covered(truths[t]["parameters"], effects[e].get("parameters", {}))
    ]
    # `after`: the gap after the named effects are added to the simulation.
    gap = (diagnosis or {}).get("gap") or {}
    noise_floor, after = gap.get("noise_floor"), gap.get("after")
    return Verdict(
        name,
        answer["kind"],
        tuple(each["name"] for each in hidden),
        float(max((each["multiple"] for each in hidden), default=0.0)),
        "failed" if diagnosis is None else str(diagnosis["verdict"]),
        name_sets,
        bool(truths) and len(is_right) == len(truths) and all(is_right),
        sum(is_extra),
        tuple(covered),
        after / noise_floor if noise_floor and after is not None and name_sets else None,
        seconds,
        sum(is_brought),
    )


def score_set(out: Path) -> list[Verdict]:
    """Return the scores of all diagnosed cases of the set in `out`.

    Raises:
        ValueError: if a file of the set has changed, or no case was diagnosed.
    """
    answers, verdicts = open_answers(out), []
    in_rotorpy = simulator_of(out) == ROTORPY
    for name, answer in answers.items():
        folder = out / RESULTS / name
        if not any((folder / mark).is_file() for mark in (TIMED, FAILED)):
            continue
        hubs = None
        if in_rotorpy:
            vehicle = load_vehicle(str(out / "cases" / name / "vehicle.toml"))
            hubs = hub_damping(answer["effects"], vehicle)
        timing = _read_if_valid(folder / TIMED)
        # A diagnosis without its time did not end normally.
        diagnosis = _read_if_valid(folder / "diagnosis.json") if timing else None
        seconds = timing["seconds"] if timing else None
        verdicts.append(score_case(name, answer, diagnosis, seconds, hubs))
    if not verdicts:
        raise ValueError(
            f"{out / RESULTS}: no case was diagnosed yet; do that with `suite blind run`"
        )
    return verdicts


def not_run(out: Path, verdicts: Sequence[Verdict]) -> list[str]:
    """Return the cases of the set in `out` without a score."""
    scored = {v.case for v in verdicts}
    return [name for name in load_manifest(out).cases if name not in scored]


def shares(verdicts: Sequence[Verdict]) -> list[Share]:
    """Return the rows of the table with shares; rows without any case are left out."""

    def of(kind: str) -> list[Verdict]:
        return [v for v in verdicts if v.kind == kind]

    single, null, pair = of("single"), of("null"), of("pair")
    # A failed diagnosis names nothing, which must not count as correct.
    completed = [v for v in verdicts if v.verdict != "failed"]
    lines = [
        ("single effects: named, nothing else", "96 %", [v.exact for v in single]),
        *((f"  of these at {times:g} times detectable", "", [v.exact for v in single
           if min(MULTIPLES, key=lambda step: abs(step - v.multiple)) == times])
          for times in MULTIPLES),
        _without_hubs(single),
        ("single effects: named, others perhaps too", "", [v.found for v in single]),
        ("single effects: verdict `named`", "", [v.verdict == "named" for v in single]),
        ("nulls: something named", "at most 1 %",
         [bool(v.named) for v in completed if v.kind == "null"]),
        ("nulls: verdict `no_gap`", "95 %", [v.verdict == "no_gap" for v in null]),
        ("outside the catalogue: `unknown` or `partly`", "85 %",
         [_is_expected(v) for v in of("outside")]),
        ("pairs: both named", "", [v.found for v in pair]),
        ("pairs: both named, nothing else", "90 %", [v.exact for v in pair]),
        _without_hubs(pair),
        ("inseparable: the right set", "95 %", [v.exact for v in of("blurred")]),
        ("the same with separating flights", "95 %", [v.exact for v in of("separated")]),
        ("cases with a false extra name", "", [v.extra > 0 for v in completed if v.hidden]),
        (COVERED, "93-97 %", [x for v in verdicts for x in v.covered]),
        (f"gap after within {GAP_LIMIT} of the noise floor, where named", "all",
         [ratio <= GAP_LIMIT for ratio in _gap_ratios(verdicts)]),
        ("diagnosis failed", "none", [v.verdict == "failed" for v in verdicts]),
    ]  # fmt: skip
    rows = []
    for what, wanted, flags in lines:
        if flags:
            # The intervals of one diagnosis are not independent of each other.
            groups = [v.covered for v in verdicts] if what == COVERED else [[x] for x in flags]
            share = wilson_by_group(groups)
            rows.append(Share(what, sum(flags), len(flags), share.low, share.high, wanted))
    return rows


def report(out: Path, verdicts: Sequence[Verdict]) -> str:
    """Write `table.md` and `table.json` into `out` and return the table (Markdown)."""
    counted = shares(verdicts)
    lines = [
        [s.what, f"{s.count} of {s.of} ({100 * s.count / s.of:.0f} %)",
         f"{100 * s.low:.0f}-{100 * s.high:.0f} %", s.wanted]
        for s in counted
    ]  # fmt: skip
    times = [v.seconds for v in verdicts if v.seconds is not None]
    ratios = _gap_ratios(verdicts)
    if times:
        lines.append(["seconds a case, median", f"{median(times):.3g} s", "", ""])
    if ratios:
        what = "gap after over noise floor where named, median"
        lines.append([what, f"{median(ratios):.3g}", "", ""])
    unexpected = [
        [v.case, v.kind, ", ".join(v.hidden) or "–", f"{v.multiple:.1f}", v.verdict,
         "; ".join(" or ".join(group) for group in v.named) or "–"]
        for v in verdicts
        if not _is_expected(v)
    ]  # fmt: skip
    heads = ["case", "kind", "hidden", "x detectable", "verdict", "named"]
    title = f"{len(unexpected)} of {len(verdicts)} cases are not as expected:"
    missing, failed = not_run(out, verdicts), load_manifest(out).failed
    count = len(missing) + len(verdicts)
    # The versions of the code that diagnosed the cases.
    paths = (out / RESULTS / v.case / "diagnosis.json" for v in verdicts if v.seconds is not None)
    found = ((_read_if_valid(path) or {}).get("git_commit") for path in paths)
    commits = sorted({commit or "unknown" for commit in found})
    notes = [
        len(commits) > 1
        and f"Diagnosed by {len(commits)} versions of the code: {', '.join(commits)}.",
        missing and f"Not run yet, so in none of these numbers: {len(missing)} of {count} cases.",
        failed and f"Not made: {', '.join(failed)}.",
    ]
    text = "\n".join(
        [
            markdown(table(["", "", "95 % interval", "wanted"], lines)),
            markdown(table(heads, unexpected, title)),
            *(f"{note}\n" for note in notes if note),
        ]
    )
    header = stamp(SCHEMA, None)
    write_text(out / "table.md", f"{text}\n<!-- {stamp_text(header)} -->\n")
    summary = {
        **header,
        "shares": counted,
        "seconds_median": median(times) if times else None,
        "not_run": missing,
        "diagnosed_by": commits,
        "cases": verdicts,
    }
    write_json(out / "table.json", summary)
    return text


def _gap_ratios(verdicts: Sequence[Verdict]) -> list[float]:
    """Return the gaps over their noise floors of the cases whose effects are named.

    Random effects (gusts) are left out: naming them does not predict a flight.
    """
    random_effects = {name for name, effect in EFFECTS.items() if effect.random}
    named = (v for v in verdicts if v.found and not random_effects & set(v.hidden))
    return [v.gap_ratio for v in named if v.gap_ratio is not None]


def _without_hubs(verdicts: Sequence[Verdict]) -> tuple[str, str, list[bool]]:
    """Return a row (description, goal, flags): exact cases without a named damping by moving hubs.

    The row is empty if no diagnosis names such a damping.
    """
    brought = any(v.brought for v in verdicts)
    flags = [v.exact and not v.brought for v in verdicts if brought]
    kind = verdicts[0].kind if verdicts else ""
    return f"  {kind}: with no damping by moving hubs in addition", "", flags


def _match(
    truths: Sequence[Mapping[str, Any]], name_sets: Sequence[tuple[str, ...]]
) -> dict[int, int]:
    """Return the index of each named true effect -> index of the set of names that names it.

    A set is used once. The first name of a set has priority over its alternatives.
    """
    pairs: dict[int, int] = {}
    for first_only in (True, False):
        for t, truth in enumerate(truths):
            for e, group in enumerate(name_sets):
                names = group[:1] if first_only else group
                if t not in pairs and e not in pairs.values() and truth["name"] in names:
                    pairs[t] = e
    return pairs


def _is_right(truth: Mapping[str, Any], group: tuple[str, ...]) -> bool:
    """Return whether a set of names has all required alternatives and only allowed ones."""
    # Hypotheses of several effects are ignored: the oracle has only single effects.
    others = {name for name in group if len(effects_in(name)) == 1} - {truth["name"]}
    return set(truth["required"]) <= others <= set(truth["allowed"]) | set(truth["required"])


def _covered(truth: Mapping[str, Any], estimated: Mapping[str, Any]) -> Iterator[bool]:
    """Yield for each component of an effect whether its interval contains the true value."""
    for name, value in truth.items():
        interval = (estimated.get(name) or {}).get("ci95")
        if interval is None:
            continue
        values = value if isinstance(value, list) else [value]
        intervals = interval if isinstance(value, list) else [interval]
        if "index" in estimated:
            # Only some components (numbered from 1) are listed, such as one weak rotor.
            index = estimated["index"]["value"]
            index, intervals = (
                (index, interval) if isinstance(index, list) else ([index], [interval])
            )
            values = [values[int(number) - 1] for number in index]
        for true, span in zip(values, intervals, strict=False):
            if true is not None and span is not None and None not in span:
                yield bool(span[0] <= true <= span[1])


def _is_expected(v: Verdict) -> bool:
    """Return whether the diagnosis has the correct verdict and the correct names."""
    if v.kind == "null":
        return v.verdict == "no_gap"
    if v.kind == "outside":
        return v.verdict in ("unknown", "partly")
    return v.exact


def _read_if_valid(path: Path) -> Any:
    """Return the contents of a JSON file; None if it is missing or not JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
