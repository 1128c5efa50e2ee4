"""The steps of a diagnosis for one source: search, held-out test, relevance, residual."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.estimate.block import Estimate
from suite.diagnose.estimate.gauss_newton import fit, intervals95
from suite.diagnose.estimate.parameters import Candidate, effects_in, indices_of
from suite.diagnose.search.evaluation import NamedEffect, SearchResult
from suite.diagnose.sources.source import Finding, Source
from suite.diagnose.verdict.gap import EffectSize, Gap

APART = 1.5
"""Parameters contradict each other where their 95 % intervals are further apart than their
half-widths by this factor."""


def examine(
    source: Source, earlier: Sequence[Finding], say: Callable[[str], None], seed: int
) -> tuple[Finding, list[str]]:
    """Return the finding of `source`, and warnings.

    Args:
        source: what is examined.
        earlier: findings of other sources. The first of them may contradict a named effect.
        say: receives a line for people about each step.
        seed: of all draws.
    """
    found, warnings = source.search(say, seed), list[str]()
    if earlier and not source.keeps_small:
        among, first = source.among, earlier[0]
        for refused, words in contradicted(first.search, found):
            warnings.append(
                f"{source.name}: {refused.label} is contradicted by {first.source.name} ({words}): "
                "left out"
            )
            among = [c for c in among if not set(c.indices) & set(refused.indices)]
            found = replace(source, among=among).search(say, seed)
    if not found.named and source.otherwise:
        other = source.otherwise.search(say, seed)
        source, found = (source.otherwise, other) if other.named else (source, found)
    before = after = source.gap(found, found.start.theta)
    if found.named:
        after = source.gap(found, found.estimate.theta)
    if found.named and source.worse(before, after):
        labels = ", ".join(one.label for one in found.candidates)
        warnings.append(f"{labels}: withdrawn, held-out flights are no better for it")
        found, after = found.refitted(()), before
    found, after, without, gone = confirmed(source, found, (before, after))
    warnings += [f"{label}: withdrawn, held-out flights are no better for it" for label in gone]
    explained = found, (before, after)
    found, after, sizes, small = relevant_part(source, found, (before, after))
    for name, size in small:
        own = "no larger than the model's own error" if size.relevant(source.limits) else ""
        warnings.append(f"{name}: left out, {own or 'too small to matter'}: {size.words()}")
    if not source.small_explains:
        explained = found, (before, after)
    remaining = source.remaining(*explained, seed)
    if remaining.wind and found.named and not source.worse(after, before):
        # Wind that lasts from one stretch to the next has the effect of many constant numbers.
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
    """Return `finding` without its named effects, which leave most of the gap."""
    bare, last = finding.search.refitted(()), finding.remaining
    left = finding.source.remaining(bare, (finding.before, finding.before), seed)
    swing = left.swing if last.swing else None
    where = left.where or last.where
    left = left._replace(structured=True, share=1.0, where=where, wind=None, swing=swing)
    return replace(
        finding, search=bare, names=(), after=finding.before, without={}, half_width={}, sizes={},
        remaining=left, control=None,
    )  # fmt: skip


def confirmed(
    source: Source, found: SearchResult, gaps: tuple[Gap, Gap]
) -> tuple[SearchResult, Gap, dict[str, Gap], list[str]]:
    """Return `found` without the effects that do not lower the gap on held-out flights.

    Where the residual stays above the noise floor, model errors bias every parameter: an effect
    then has to lower the gap by a share of the residual. An effect stays where these flights are
    not sensitive to it, as high flights are not to the ground effect. `gaps` are those before and
    after.

    Returns:
        What stays, its gap, the gaps without each of its names, and the labels of what went.
    """
    (before, after), gone, limits = gaps, list[str](), source.limits
    while found.named:
        without = _without_each(source, found)
        # Of the mean score, 1 is noise and all else what no name explains.
        rest = max(0.0, 1.0 - 1.0 / after.score.mean()) if found.judged.evidence.off else 0.0
        refused = [
            one
            for one in found.candidates
            if without[one.label].energy.sum()
            <= (1.0 + limits.least_next_to_rest * rest) * after.energy.sum()
            and source.shows(found, one)
        ]
        if not refused:
            return found, after, without, gone
        label = min((one.label for one in refused), key=lambda k: float(without[k].energy.sum()))
        gone.append(label)
        kept = tuple(one for one in found.named if one.candidate.label != label)
        if kept:
            found = found.refitted(kept)
            kept = _acting(found)
        if not kept:
            return found.refitted(()), before, {}, gone
        if len(kept) < len(found.named):
            gone += [one.candidate.label for one in found.named if one not in kept]
            found = found.refitted(kept)
        after = source.gap(found, found.estimate.theta)
    return found, after, {}, gone


def relevant_part(
    source: Source, found: SearchResult, gaps: tuple[Gap, Gap]
) -> tuple[SearchResult, Gap, dict[str, EffectSize], list[tuple[str, EffectSize]]]:
    """Return `found` without the effects below the threshold of relevance.

    Where the gap was below that threshold from the start, only faults of the log may be named.
    `gaps` are those before and after the search.

    Returns:
        What stays, its gap, the sizes of its effects by name, and what was left out.
    """
    (before, after), out = gaps, list[tuple[str, EffectSize]]()
    none = bool(found.named) and not source.matters(before)
    while found.named:
        both = source.sizes(found)
        sizes = {name: size for name, (size, _) in both.items()}
        small = [
            name
            for name, (_, most) in both.items()
            if not source.keeps_small
            and ((none and not EFFECTS[name].of_log) or not most.relevant(source.limits))
        ]
        if not small:
            return found, after, sizes, out
        out += [(name, sizes[name]) for name in small]
        kept = tuple(one for one in found.named if one.candidate.name not in small)
        if not kept:
            return found.refitted(()), before, {}, out
        found = found.refitted(kept)
        after = source.gap(found, found.estimate.theta)
    return found, after, {}, out


def control(source: Source, found: SearchResult) -> tuple[str, Gap] | None:
    """Return the best effect that is neither named nor a rival, fitted alone, and its gap."""
    taken = {candidate.name for candidate in found.candidates}
    taken |= {name for one in found.named for rival in one.rivals for name in effects_in(rival)}
    among = (s.candidate for s in found.first if not s.candidate.parts)
    wrong = next((one for one in among if one.name not in taken), None)
    if wrong is None:
        return None
    theta = found.fitted_anew(found.start, list(wrong.indices)).theta
    return wrong.label, source.gap(found, theta)


def _acting(found: SearchResult) -> tuple[NamedEffect, ...]:
    """Return the named effects that have an influence: a wind without a drag has none."""
    informed = np.einsum("wkk->k", found.judged.equations.along_numbers(found.indices).hessian)
    at = {index: informed[k] for k, index in enumerate(found.indices)}
    return tuple(
        one for one in found.named if any(at[index] > 0.0 for index in one.candidate.indices)
    )


def _without_each(source: Source, found: SearchResult) -> dict[str, Gap]:
    """Return by label of each name the gap where all others are fitted without it."""
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
    """Return which named effects of `found` the evidence `by` contradicts, and its values in words.

    It does where their parameters, fitted to it together with its own effects, differ
    significantly.
    """
    refused = []
    widths = dict(zip(found.indices, found.half_widths(), strict=True))
    evidence = by.judged.evidence
    for name in found.candidates:
        at = list(name.indices)
        if not evidence.linearise(by.estimate, at).acts().any() or name in by.candidates:
            continue
        every = sorted({*by.indices, *at})
        best, block = fit(evidence, by.estimate, every, limits=evidence.limits)
        inside = intervals95(block.equations.along_numbers(every), evidence.draws).half_width
        for k in at:
            own, other = found.estimate.theta[k], best.theta[k]
            wide = float(inside[every.index(k)])
            if abs(own - other) > APART * (widths[k] + wide):
                refused.append((name, f"{own:.3g} here, {other:.3g} ± {wide:.2g} there"))
                break
    return refused


def one_cause(findings: Sequence[Finding]) -> tuple[tuple[Finding, ...], list[str]]:
    """Return findings in which each cause is named once.

    Of an effect that two sources name, the one with the relatively narrower interval is kept. An
    effect that is an alternative of another source's effect goes.
    """
    kept, words = list(findings), list[str]()
    for i, one in enumerate(kept):
        for j, other in enumerate(kept):
            if i == j:
                continue
            names = {name.candidate.name for name in other.names}
            stays = []
            for name in kept[i].names:
                same = [n for n in other.names if n.candidate == name.candidate]
                if same and _relative(other, name) < _relative(one, name):
                    words.append(f"{name.candidate.label}: named by {one.source.name} as well")
                elif not same and set(name.rivals) & names:
                    cause = ", ".join(sorted(set(name.rivals) & names))
                    words.append(
                        f"{one.source.name}: {name.candidate.label} is not distinguishable from "
                        f"{cause}, which {other.source.name} names"
                    )
                else:
                    stays.append(name)
            kept[i] = replace(kept[i], names=tuple(stays))
    return tuple(kept), words


def _relative(finding: Finding, name: NamedEffect) -> float:
    """Return the width of a name's intervals over its size."""
    at = list(name.candidate.indices)
    away = np.abs(finding.theta[at] - finding.search.start.theta[at])
    return float(np.mean([finding.half_width[i] for i in at]) / max(away.mean(), 1e-12))
