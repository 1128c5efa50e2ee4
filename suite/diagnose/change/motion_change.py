"""What has changed in how a vehicle moves: each flight's own number, before and after.

What changes within a flight tells a drag or a flapping of that flight alone. The numbers of the
reference flights and those of the others are two samples, whose means are compared by how flights
differ within each (Welch 1947, doi 10.1093/biomet/34.1-2.28), after Bonferroni over all candidates
and their numbers. The vehicle file need not be right: what it lacks is in both samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import ttest_ind

from suite.diagnose.change.reference import in_balance
from suite.diagnose.estimate.parameters import Candidate, at_bound, usual_first
from suite.diagnose.evidence.evidence import flights_agree
from suite.diagnose.evidence.moments import ViewData, centred, weights_of
from suite.diagnose.evidence.views import ViewEvidence, view_candidates
from suite.diagnose.search.look import Look, NamedEffect, SearchResult

SLIGHT = 0.1
"""Share of a change by which its numbers may lie beyond what is physical; noise does that."""


def within_flights(data: ViewData) -> ViewData:
    """Return `data` with residual and slope less their flights' means."""
    return data._replace(
        residual=centred(data.residual, data.flight), slope=centred(data.slope, data.flight)
    )


def own_changes(inside: ViewData, indices: Sequence[int], scatter: np.ndarray) -> np.ndarray:
    """Return by how much each of F flights alone wants the K numbers elsewhere, (F, K).

    Args:
        inside: from `within_flights`.
        indices: the numbers.
        scatter: (3,) noise by axis.
    """
    found = []
    for number in np.unique(inside.flight):
        rows = inside.flight == number
        slope = (inside.slope[rows][..., list(indices)] / scatter[:, None]).reshape(
            -1, len(indices)
        )
        left = (inside.residual[rows] / scatter).ravel()
        found.append(np.linalg.lstsq(slope, left, rcond=1e-6)[0])
    return np.array(found)


def search_motion_change(
    reference: ViewEvidence, task: ViewEvidence, among: Sequence[Candidate]
) -> SearchResult | None:
    """Return the one of `among` that has changed since `reference`, None where none stands out.

    Its numbers are totals. Both sets need two flights at least.
    """
    start, limits = in_balance(reference), task.limits
    sets = [within_flights(one.left(start, None)) for one in (reference, task)]
    if min(len(np.unique(one.flight)) for one in sets) < 2:
        return None
    weights, space = weights_of(sets[1], limits), task.space
    evidence = replace(task, weights=weights)
    left = view_candidates(among, evidence.linearise(evidence.at(start)))
    tests = sum(len(one.indices) for one in left)
    tried = []
    for candidate in left:
        at = list(candidate.indices)
        before, after = (own_changes(one, at, weights.scatter) for one in sets)
        _, chance = ttest_ind(before, after, equal_var=False)
        p_value = float(np.nan_to_num(np.asarray(chance), nan=1.0).min()) * tests
        if p_value > limits.change_p_value:
            continue
        since, wanted = before.mean(axis=0), after.mean(axis=0)
        gains, whole = _gains(sets[1], at, since, after, weights.scatter)
        share = float(gains.sum() / whole)
        theta = start.copy()
        theta[at] += wanted
        possible = np.clip(theta, space.array("low"), space.array("high"))
        beyond = np.linalg.norm((possible - theta)[at])
        if beyond > SLIGHT * np.linalg.norm(wanted - since) or at_bound(space, possible, candidate):
            continue  # that is no fit
        if flights_agree(gains) and share >= limits.least_view_share:
            told = tuple(gains.tolist())
            name = NamedEffect(candidate, p_value, sum(told), gains=told, share=share)
            tried.append((name, since, possible))
    if not tried:
        return None
    most = max(name.share for name, *_ in tried)
    alike = [one for one in tried if one[0].share >= (1.0 - limits.rival_share) * most]
    alike.sort(key=lambda one: usual_first(space, one[2], one[0].candidate))
    (name, since, theta), *others = alike
    begun = start.copy()
    begun[list(name.candidate.indices)] += since
    rivals = tuple(dict.fromkeys(other.candidate.name for other, *_ in others))
    at = evidence.at(theta)
    block = evidence.linearise(at, sorted(name.candidate.indices))
    last = Look(evidence, at, block, block.equations())
    named = (replace(name, rivals=rivals),)
    return SearchResult(named, evidence.at(begun), last, last, [], 0.0)


def _gains(
    inside: ViewData, at: list[int], since: np.ndarray, after: np.ndarray, scatter: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return by how much each flight's squared error falls, and the sum of it before.

    From the reference's numbers `since` (K,) to those that the other flights want; `after` (F, K).
    """
    gains, whole = [], 0.0
    for k, number in enumerate(np.unique(inside.flight)):
        rows = inside.flight == number
        slope, others = inside.slope[rows][..., at], np.delete(after, k, axis=0).mean(axis=0)
        errors = [
            float((((inside.residual[rows] - slope @ change) / scatter) ** 2).sum())
            for change in (since, others)
        ]
        gains.append(errors[0] - errors[1])
        whole += errors[0]
    return np.array(gains), max(whole, 1e-12)
