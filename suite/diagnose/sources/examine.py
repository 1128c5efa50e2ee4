"""The steps of a diagnosis for one source of evidence (rollouts, force or torque).

The steps are search, test on held-out flights, test of relevance, and analysis of the remaining
error. The argument `found` is always the result of a search: named effects and their fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.estimate.block import Estimate
from suite.diagnose.estimate.gauss_newton import TINY
from suite.diagnose.estimate.parameters import Candidate, effects_in, indices_of
from suite.diagnose.search.evaluation import NamedEffect, SearchResult
from suite.diagnose.search.search import settled
from suite.diagnose.sources.source import TOGETHER, TOO_SMALL, Finding, Source
from suite.diagnose.verdict.gap import EffectSize, Gap
from tracks.common.figures import rounded

CONTRADICTION = 1.5
"""Two values contradict each other if they differ by more than this many sums of half-widths."""


def examine(
    source: Source, earlier: Sequence[Finding], say: Callable[[str], None], seed: int
) -> tuple[Finding, list[str]]:
    """Search for named effects with one source, and test them; return the finding and warnings.

    Effects that contradict the first of the `earlier` findings are left out.
    """
    # Search. If an earlier source contradicts some of the effects, search again without them.
    # (Not if a change since reference flights is searched for, as `names_small` shows.)
    found, warnings = source.search(say, seed), list[str]()
    if earlier and not source.names_small:
        first_finding = earlier[0]
        refused = contradicted(first_finding.search, found)
        warnings += [
            f"{source.name}: {candidate.label} is contradicted by "
            f"{first_finding.source.name} ({words}): left out"
            for candidate, words in refused
        ]
        if refused:
            excluded = set(indices_of([candidate for candidate, _ in refused]))
            allowed = [c for c in source.candidates if not set(c.indices) & excluded]
            found = replace(source, candidates=allowed).search(say, seed)
    # The fallback is a second source, for the case that this one names nothing.
    if not found.named and source.fallback:
        by_fallback = source.fallback.search(say, seed)
        source, found = (source.fallback, by_fallback) if by_fallback.named else (source, found)
    before = source.gap(found, found.start.theta)
    tested = _tested(source, found, before)
    left_out = {c.name for c in found.candidates} - {c.name for c in tested.found.candidates}
    if left_out and tested.found.named and not source.names_small:
        # Without them, another candidate may explain the flights better than one of the names.
        among = [c for c in source.candidates if not left_out & {one.name for one in c.singles}]
        again = settled(tested.found, among, say, seed)
        tested = tested.followed_by(_tested(source, again, before), source.small_explains)
    found, after, sizes = tested.found, tested.after, tested.sizes
    warnings += tested.warnings
    remaining = source.remaining(*tested.explained, seed)
    if tested.too_small and source.small_explains and not remaining.wind:
        remaining = remaining._replace(reason=TOO_SMALL)
    if remaining.wind and found.named and not source.is_worse(after, before):
        # Several constant effects together can imitate a wind that is correlated over seconds. If
        # held-out flights are no worse without these effects, the wind is the simpler cause.
        found, after, sizes = found.refitted(()), before, {}
        remaining = source.remaining(found, (before, before), seed)
    labels = ", ".join(one.label for one in found.candidates) or "nothing"
    gaps = [rounded(gap.rms, 3) for gap in (before, after)]
    say(f"{source.name}: {labels}; gap {gaps[0]} as given, {gaps[1]} with it")
    return Finding(
        source=source,
        search=found,
        names=found.named,
        before=before,
        after=after,
        without={one.label: tested.without[one.label] for one in found.candidates},
        half_width=dict(zip(found.indices, map(float, found.half_widths()), strict=True)),
        sizes=sizes,
        negligible=tuple(tested.too_small),
        remaining=remaining,
        control=control(source, found) if found.named else None,
    ), warnings


class _Tested(NamedTuple):
    """The names of a search that passed all tests."""

    found: SearchResult
    after: Gap
    """Gap with them."""
    without: dict[str, Gap]
    """Gap without each of them, by its label."""
    sizes: dict[str, EffectSize]
    """Their sizes by name."""
    too_small: list[tuple[str, EffectSize]]
    """Names and sizes of the effects that were left out as too small."""
    explained: tuple[SearchResult, tuple[Gap, Gap]]
    """The search result for which the remaining error counts, and the gaps before and after it."""
    warnings: list[str]

    def followed_by(self, later: _Tested, small_explains: bool) -> _Tested:
        """Return the result of a second test, `later`, with what the first one left out."""
        explained = self.explained if self.too_small and small_explains else later.explained
        too_small, warnings = self.too_small + later.too_small, self.warnings + later.warnings
        return later._replace(explained=explained, too_small=too_small, warnings=warnings)


def _tested(source: Source, found: SearchResult, before: Gap) -> _Tested:
    """Test the names of `found` on held-out flights, and for relevance; `before` is the gap."""
    # On held-out flights: first all named effects together, then (in rollouts) each alone.
    after, warnings = before, list[str]()
    if found.named:
        after = source.gap(found, found.estimate.theta)
    if found.named and source.is_worse(before, after):
        labels = ", ".join(one.label for one in found.candidates)
        warnings.append(f"{labels}: withdrawn, held-out flights are no better for it")
        found, after = found.refitted(()), before
    found, after, without, withdrawn = confirmed(source, found, after)
    warnings += [
        f"{label}: withdrawn, held-out flights are no better for it" for label in withdrawn
    ]
    if uncertain := [one for one in found.named if _is_uncertain(found, one)]:
        labels = ", ".join(one.candidate.label for one in uncertain)
        warnings.append(
            f"{labels}: withdrawn, the flights disagree about its size: its interval has the "
            "vehicle file's value. Are they of one vehicle?"
        )
        found = found.refitted([one for one in found.named if one not in uncertain])
        after = source.gap(found, found.estimate.theta) if found.named else before
        without = _without_each(source, found)
    # Leave out effects that are too small. Depending on the source, the remaining error is still
    # computed with them (`small_explains`).
    explained = found, (before, after)
    found, after, sizes, too_small = relevant_part(source, found, (before, after))
    if too_small:
        without = _without_each(source, found)
    for name, size in too_small:
        reason = "too small to matter"
        if size.relevant(source.limits):
            reason = "no larger than the model's own error, or the other effects cancel it"
        warnings.append(f"{name}: left out, {reason}: {size.words()}")
    if not source.small_explains:
        explained = found, (before, after)
    return _Tested(found, after, without, sizes, too_small, explained, warnings)


def without_names(finding: Finding, seed: int) -> Finding:
    """Return `finding` without its named effects: all of the error counts as unexplained."""
    bare, with_names = finding.search.refitted(()), finding.remaining
    remaining = finding.source.remaining(bare, (finding.before, finding.before), seed)
    # Without the names an error of the model may oscillate. A swing (an oscillating force) counts
    # only if it also remained with the names.
    swing = remaining.swing if with_names.swing else None
    where = remaining.where or with_names.where
    remaining = remaining._replace(structured=True, share=1.0, where=where, wind=None, swing=swing)
    return replace(
        finding, search=bare, names=(), after=finding.before, without={}, half_width={}, sizes={},
        remaining=remaining, control=None,
    )  # fmt: skip


def confirmed(
    source: Source, found: SearchResult, after: Gap
) -> tuple[SearchResult, Gap, dict[str, Gap], list[str]]:
    """Withdraw the effects that do not lower the gap on held-out flights, one at a time.

    If the error stays above the noise floor, model errors bias every parameter. An effect then has
    to lower the squared error by a share of the remaining error. An effect is kept if the held-out
    flights are not sensitive to it, such as the ground effect in high flights.

    Returns:
        The result with the confirmed effects, the gap with them (at first `after`), the gap without
        each of them (by its label), and the labels of the withdrawn effects.
    """
    withdrawn, limits = list[str](), source.limits
    while found.named:
        without = _without_each(source, found)
        # A mean score of 1 is noise; more is an error that no named effect explains. `excess` is
        # the share of that error in the score.
        has_unexplained_error = found.judged.evidence.misfit_is_noise
        excess = max(0.0, 1.0 - 1.0 / after.score.mean()) if has_unexplained_error else 0.0
        # Without an effect that is real, the squared error is larger than this.
        least = (1.0 + limits.least_next_to_rest * excess) * after.energy.sum()
        refused = [
            one
            for one in found.candidates
            if without[one.label].energy.sum() <= least and source.would_show(found, one)
        ]
        if not refused:
            return found, after, without, withdrawn
        # Withdraw the effect whose loss costs least; the others may be confirmed without it. Others
        # may also lose their influence without it, as a wind without a drag.
        lost = [min(refused, key=lambda one: float(without[one.label].energy.sum()))]
        while lost:
            withdrawn += [candidate.label for candidate in lost]
            found = found.refitted([one for one in found.named if one.candidate not in lost])
            equations = found.judged.block.equations.along_numbers(found.indices)
            information = np.einsum("wkk->k", equations.hessian)
            informed = {i for i, v in zip(found.indices, information, strict=True) if v > 0.0}
            lost = [one for one in found.candidates if not informed & set(one.indices)]
        after = source.gap(found, found.estimate.theta)
    return found, after, {}, withdrawn


def relevant_part(
    source: Source, found: SearchResult, gaps: tuple[Gap, Gap]
) -> tuple[SearchResult, Gap, dict[str, EffectSize], list[tuple[str, EffectSize]]]:
    """Leave out the effects below the threshold of relevance.

    If all named effects together are below it, only faults of the log may be named. `gaps` are
    those without any named effect and with all of them.

    Returns:
        The result with the relevant effects, the gap with them, their sizes by name, and the names
        and sizes of the effects that were left out.
    """
    (before, after), left_out = gaps, list[tuple[str, EffectSize]]()
    all_are_small: bool | None = None
    while found.named:
        ranges = source.sizes(found)
        together = ranges.pop(TOGETHER, None)
        if all_are_small is None:  # of what the search has found; the rest may be smaller
            all_are_small = together is not None and not together[1].relevant(source.limits)
        sizes = {name: size for name, (size, _) in ranges.items()}
        too_small = [
            name
            for name, (_, upper) in ranges.items()
            if not source.names_small
            and (
                (all_are_small and not EFFECTS[name].of_log)
                or not upper.relevant(source.limits)
                or not any(upper)  # also where every size counts as relevant
            )
        ]
        if not too_small:
            return found, after, sizes, left_out
        left_out += [(name, sizes[name]) for name in too_small]
        found = found.refitted([one for one in found.named if one.candidate.name not in too_small])
        after = source.gap(found, found.estimate.theta) if found.named else before
    return found, after, {}, left_out


def control(source: Source, found: SearchResult) -> tuple[str, Gap] | None:
    """Return label and gap of the best effect that is neither named nor an alternative, if any.

    Its gap shows how much an effect that is surely wrong would lower the error.
    """
    excluded = {candidate.name for candidate in found.candidates}
    alternatives = [label for named in found.named for label in named.rivals]
    excluded |= {name for label in alternatives for name in effects_in(label)}
    # A candidate with parts is a combination of effects.
    single = (score.candidate for score in found.first if not score.candidate.parts)
    wrong = next((candidate for candidate in single if candidate.name not in excluded), None)
    if wrong is None:
        return None
    fitted = found.judged.evidence.fitted(found.start, list(wrong.indices))
    return wrong.label, source.gap(found, fitted.at.theta)


def _is_uncertain(found: SearchResult, named: NamedEffect) -> bool:
    """Return whether the interval of an effect's only number contains the start value.

    The test that named the effect compares stretches, the interval compares flights as well.
    """
    if len(named.candidate.indices) > 1:
        return False  # numbers may be uncertain alone but not together
    (index,) = named.candidate.indices
    change = abs(found.estimate.theta[index] - found.start.theta[index])
    return bool(change <= found.half_widths()[found.indices.index(index)])


def _without_each(source: Source, found: SearchResult) -> dict[str, Gap]:
    """Return the gap without each named effect, by its label; the other effects are refitted."""
    start, gaps = found.start.theta, {}
    for one in found.candidates:
        others = [candidate for candidate in found.candidates if candidate is not one]
        theta = start
        if others:
            theta = found.estimate.theta.copy()
            theta[list(one.indices)] = start[list(one.indices)]
            without = Estimate(theta, found.estimate.free)
            theta = found.judged.evidence.fitted(without, indices_of(others)).at.theta
        gaps[one.label] = source.gap(found, theta)
    return gaps


def contradicted(by: SearchResult, found: SearchResult) -> list[tuple[Candidate, str]]:
    """Return the named effects of `found` that the evidence of `by` contradicts, and both values.

    Each effect is fitted to that evidence, with the effects that `by` names. It is contradicted if
    a parameter differs significantly from its value in `found`.
    """
    refused = []
    widths = dict(zip(found.indices, found.half_widths(), strict=True))
    evidence = by.judged.evidence
    for candidate in found.candidates:
        indices = list(candidate.indices)
        # Evidence on which the effect does not act, or that names it too, cannot contradict it.
        if not evidence.linearise(by.estimate, indices).acts().any() or candidate in by.candidates:
            continue
        fitted = sorted({*by.indices, *indices})
        best = evidence.fitted(by.estimate, fitted)
        half = best.intervals(fitted).half_width
        for index in indices:
            value, other = found.estimate.theta[index], best.at.theta[index]
            other_half = float(half[fitted.index(index)])
            if abs(value - other) > CONTRADICTION * (widths[index] + other_half):
                words = f"{value:.3g} here, {other:.3g} ± {other_half:.2g} there"
                refused.append((candidate, words))
                break
    return refused


def one_cause(findings: Sequence[Finding]) -> tuple[tuple[Finding, ...], list[str]]:
    """Return the findings with each cause named once, and a warning for each removed name.

    If two sources name the same effect, the name with the relatively narrower interval is kept. An
    effect is removed if one of its alternatives is named by another source.
    """
    kept, warnings = list(findings), list[str]()
    for index, finding in enumerate(kept):
        for j, other in enumerate(kept):
            if index == j:
                continue
            other_names = {named.candidate.name for named in other.names}
            remaining = []
            for named in kept[index].names:
                label, source = named.candidate.label, finding.source.name
                shared_alternatives = set(named.rivals) & other_names
                is_same = any(one.candidate == named.candidate for one in other.names)
                if is_same and _relative_width(other, named) < _relative_width(finding, named):
                    warnings.append(f"{label}: named by {source} as well")
                elif not is_same and shared_alternatives:
                    warnings.append(
                        f"{source}: {label} is not distinguishable from "
                        f"{', '.join(sorted(shared_alternatives))}, which {other.source.name} names"
                    )
                else:
                    remaining.append(named)
            kept[index] = replace(kept[index], names=tuple(remaining))
    return tuple(kept), warnings


def _relative_width(finding: Finding, named: NamedEffect) -> float:
    """Return the mean half-width of the effect's intervals, relative to its mean change."""
    indices = list(named.candidate.indices)
    change = np.abs(finding.theta[indices] - finding.search.start.theta[indices])
    return float(np.mean([finding.half_width[i] for i in indices]) / max(change.mean(), TINY))
