"""The steps of a diagnosis for one source of evidence (rollouts, force or torque).

They are search, test on held-out flights, test of relevance, and analysis of the remaining error.
`diagnose.py` calls `examine` for each source, and then `one_cause` on all findings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.estimate.block import Estimate
from suite.diagnose.estimate.gauss_newton import TINY, fit, intervals95
from suite.diagnose.estimate.parameters import Candidate, effects_in, indices_of
from suite.diagnose.search.evaluation import NamedEffect, SearchResult
from suite.diagnose.sources.source import Finding, Source
from suite.diagnose.verdict.gap import EffectSize, Gap

CONTRADICTION = 1.5
"""Two values of a parameter contradict each other if they differ by more than this many times the
sum of their half-widths [1]."""


def examine(
    source: Source, earlier: Sequence[Finding], say: Callable[[str], None], seed: int
) -> tuple[Finding, list[str]]:
    """Search for named effects with one source, and test them.

    Args:
        source: the source.
        earlier: findings of other sources; the first of them may contradict a named effect.
        say: receives a line for people about each step.
        seed: seed of all random draws.

    Returns:
        The finding, and warnings for people.
    """
    found, warnings = source.search(say, seed), list[str]()
    if earlier and not source.names_small:
        first = earlier[0]
        refused = contradicted(first.search, found)
        warnings += [
            f"{source.name}: {candidate.label} is contradicted by {first.source.name} ({words}): "
            "left out"
            for candidate, words in refused
        ]
        if refused:
            excluded = set(indices_of([candidate for candidate, _ in refused]))
            allowed = [c for c in source.candidates if not set(c.indices) & excluded]
            found = replace(source, candidates=allowed).search(say, seed)
    if not found.named and source.fallback:
        other = source.fallback.search(say, seed)
        source, found = (source.fallback, other) if other.named else (source, found)
    before = after = source.gap(found, found.start.theta)
    if found.named:
        after = source.gap(found, found.estimate.theta)
    if found.named and source.is_worse(before, after):
        labels = ", ".join(one.label for one in found.candidates)
        warnings.append(f"{labels}: withdrawn, held-out flights are no better for it")
        found, after = found.refitted(()), before
    found, after, without, withdrawn = confirmed(source, found, (before, after))
    warnings += [
        f"{label}: withdrawn, held-out flights are no better for it" for label in withdrawn
    ]
    explained = found, (before, after)
    found, after, sizes, small = relevant_part(source, found, (before, after))
    for name, size in small:
        is_relevant = size.relevant(source.limits)
        reason = "no larger than the model's own error" if is_relevant else "too small to matter"
        warnings.append(f"{name}: left out, {reason}: {size.words()}")
    if not source.small_explains:
        explained = found, (before, after)
    remaining = source.remaining(*explained, seed)
    if remaining.wind and found.named and not source.is_worse(after, before):
        # Several constant effects can imitate a wind that is correlated over seconds.
        found, after, sizes = found.refitted(()), before, {}
        remaining = source.remaining(found, (before, before), seed)
    labels = ", ".join(one.label for one in found.candidates) or "nothing"
    say(f"{source.name}: {labels}; gap {before.rms:.3g} as given, {after.rms:.3g} with it")
    return Finding(
        source=source,
        search=found,
        names=found.named,
        before=before,
        after=after,
        without={one.label: without[one.label] for one in found.candidates},
        half_width=dict(zip(found.indices, map(float, found.half_widths()), strict=True)),
        sizes=sizes,
        negligible=tuple(small),
        remaining=remaining,
        control=control(source, found) if found.named else None,
    ), warnings


def without_names(finding: Finding, seed: int) -> Finding:
    """Return `finding` without its named effects, for effects that do not explain the gap."""
    bare, last = finding.search.refitted(()), finding.remaining
    remaining = finding.source.remaining(bare, (finding.before, finding.before), seed)
    swing = remaining.swing if last.swing else None
    where = remaining.where or last.where
    remaining = remaining._replace(structured=True, share=1.0, where=where, wind=None, swing=swing)
    return replace(
        finding, search=bare, names=(), after=finding.before, without={}, half_width={}, sizes={},
        remaining=remaining, control=None,
    )  # fmt: skip


def confirmed(
    source: Source, found: SearchResult, gaps: tuple[Gap, Gap]
) -> tuple[SearchResult, Gap, dict[str, Gap], list[str]]:
    """Withdraw the effects that do not lower the gap on held-out flights, one at a time.

    If the error stays above the noise floor, model errors bias every parameter. An effect then has
    to lower the gap by a share of the remaining error. An effect is kept if the held-out flights
    are not sensitive to it, such as the ground effect in high flights. `gaps` are those before and
    after the search.

    Returns:
        The result with the confirmed effects, its gap, the gaps without each of these effects, and
        the labels of the withdrawn ones.
    """
    (before, after), withdrawn, limits = gaps, list[str](), source.limits
    while found.named:
        without = _without_each(source, found)
        # A mean score of 1 is noise; more is an error that no named effect explains.
        misfit = found.judged.evidence.misfit_is_noise
        excess = max(0.0, 1.0 - 1.0 / after.score.mean()) if misfit else 0.0
        least = (1.0 + limits.least_next_to_rest * excess) * after.energy.sum()
        refused = [
            one
            for one in found.candidates
            if without[one.label].energy.sum() <= least and source.would_show(found, one)
        ]
        if not refused:
            return found, after, without, withdrawn
        label = min((one.label for one in refused), key=lambda k: float(without[k].energy.sum()))
        withdrawn.append(label)
        kept = tuple(named for named in found.named if named.candidate.label != label)
        if kept:
            found = found.refitted(kept)
            kept = _effective(found)
        if not kept:
            return found.refitted(()), before, {}, withdrawn
        if len(kept) < len(found.named):
            withdrawn += [named.candidate.label for named in found.named if named not in kept]
            found = found.refitted(kept)
        after = source.gap(found, found.estimate.theta)
    return found, after, {}, withdrawn


def relevant_part(
    source: Source, found: SearchResult, gaps: tuple[Gap, Gap]
) -> tuple[SearchResult, Gap, dict[str, EffectSize], list[tuple[str, EffectSize]]]:
    """Leave out the effects below the threshold of relevance.

    If the gap is below that threshold from the start, only faults of the log may be named. `gaps`
    are those before and after the search.

    Returns:
        The result with the relevant effects, its gap, the sizes of its effects by name, and the
        names and sizes of the effects that were left out.
    """
    (before, after), left_out = gaps, list[tuple[str, EffectSize]]()
    gap_is_small = bool(found.named) and not source.is_relevant(before)
    while found.named:
        ranges = source.sizes(found)
        sizes = {name: size for name, (size, _) in ranges.items()}
        small = [
            name
            for name, (_, upper) in ranges.items()
            if not source.names_small
            and ((gap_is_small and not EFFECTS[name].of_log) or not upper.relevant(source.limits))
        ]
        if not small:
            return found, after, sizes, left_out
        left_out += [(name, sizes[name]) for name in small]
        kept = tuple(named for named in found.named if named.candidate.name not in small)
        if not kept:
            return found.refitted(()), before, {}, left_out
        found = found.refitted(kept)
        after = source.gap(found, found.estimate.theta)
    return found, after, {}, left_out


def control(source: Source, found: SearchResult) -> tuple[str, Gap] | None:
    """Return label and gap of a wrong effect: the best one that is neither named nor a rival."""
    excluded = {candidate.name for candidate in found.candidates}
    rivals = [rival for named in found.named for rival in named.rivals]
    excluded |= {name for rival in rivals for name in effects_in(rival)}
    single = (score.candidate for score in found.first if not score.candidate.parts)
    wrong = next((candidate for candidate in single if candidate.name not in excluded), None)
    if wrong is None:
        return None
    theta = found.fitted_anew(found.start, list(wrong.indices)).theta
    return wrong.label, source.gap(found, theta)


def _effective(found: SearchResult) -> tuple[NamedEffect, ...]:
    """Return the named effects that influence these flights; a wind without a drag does not."""
    information = np.einsum("wkk->k", found.judged.equations.along_numbers(found.indices).hessian)
    by_index = dict(zip(found.indices, information, strict=True))
    return tuple(
        named
        for named in found.named
        if any(by_index[index] > 0.0 for index in named.candidate.indices)
    )


def _without_each(source: Source, found: SearchResult) -> dict[str, Gap]:
    """Return by the label of each named effect the gap if all others are fitted without it."""
    start, gaps = found.start.theta, {}
    for one in found.candidates:
        others = [candidate for candidate in found.candidates if candidate is not one]
        theta = start
        if others:
            theta = found.estimate.theta.copy()
            theta[list(one.indices)] = start[list(one.indices)]
            without = Estimate(theta, found.estimate.free)
            theta = found.fitted_anew(without, indices_of(others)).theta
        gaps[one.label] = source.gap(found, theta)
    return gaps


def contradicted(by: SearchResult, found: SearchResult) -> list[tuple[Candidate, str]]:
    """Return the named effects of `found` that the evidence of `by` contradicts, with both values.

    The effect's parameters are fitted to that evidence, together with the effects that `by` names.
    They contradict if they differ significantly from those in `found`.
    """
    refused = []
    widths = dict(zip(found.indices, found.half_widths(), strict=True))
    evidence = by.judged.evidence
    for candidate in found.candidates:
        own = list(candidate.indices)
        if not evidence.linearise(by.estimate, own).acts().any() or candidate in by.candidates:
            continue
        fitted = sorted({*by.indices, *own})
        best, block = fit(evidence, by.estimate, fitted, limits=evidence.limits)
        equations = block.equations.along_numbers(fitted)
        half = intervals95(equations, evidence.flights_differ_p).half_width
        for index in own:
            value, other = found.estimate.theta[index], best.theta[index]
            other_half = float(half[fitted.index(index)])
            if abs(value - other) > CONTRADICTION * (widths[index] + other_half):
                words = f"{value:.3g} here, {other:.3g} ± {other_half:.2g} there"
                refused.append((candidate, words))
                break
    return refused


def one_cause(findings: Sequence[Finding]) -> tuple[tuple[Finding, ...], list[str]]:
    """Remove names so that each cause is named once.

    If two sources name the same effect, the relatively narrower interval is kept. An effect that is
    an alternative of another source's effect is removed.

    Returns:
        The findings with the remaining names, and a warning for each removed name.
    """
    kept, warnings = list(findings), list[str]()
    for i, finding in enumerate(kept):
        for j, other in enumerate(kept):
            if i == j:
                continue
            other_names = {named.candidate.name for named in other.names}
            remaining = []
            for named in kept[i].names:
                label, source = named.candidate.label, finding.source.name
                shared = set(named.rivals) & other_names
                is_same = any(one.candidate == named.candidate for one in other.names)
                if is_same and _relative_width(other, named) < _relative_width(finding, named):
                    warnings.append(f"{label}: named by {source} as well")
                elif not is_same and shared:
                    warnings.append(
                        f"{source}: {label} is not distinguishable from "
                        f"{', '.join(sorted(shared))}, which {other.source.name} names"
                    )
                else:
                    remaining.append(named)
            kept[i] = replace(kept[i], names=tuple(remaining))
    return tuple(kept), warnings


def _relative_width(finding: Finding, named: NamedEffect) -> float:
    """Return the mean width of the effect's intervals, relative to its mean change."""
    indices = list(named.candidate.indices)
    change = np.abs(finding.theta[indices] - finding.search.start.theta[indices])
    return float(np.mean([finding.half_width[i] for i in indices]) / max(change.mean(), TINY))
