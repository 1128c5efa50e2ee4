"""The sources of evidence `force` and `torque` where a change since reference flights is searched.

Reference flights are earlier flights of the same vehicle. Their residual is subtracted, so the
vehicle file need not be right. The means of whole flights are compared first. If no mean has
changed, the fallback searches for a change that shows only in motion. The fits are in
`suite/diagnose/search/change.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from suite.diagnose.data.flights import ViewFlights, ready
from suite.diagnose.estimate.gauss_newton import TINY
from suite.diagnose.estimate.parameters import Candidate
from suite.diagnose.evidence.moments import means_of
from suite.diagnose.evidence.views import ViewEvidence, view_candidates
from suite.diagnose.search.change import (
    RotorSpread,
    change_evidence,
    less_reference_residual,
    rotor_spread,
    search_motion_change,
)
from suite.diagnose.search.evaluation import SearchResult
from suite.diagnose.sources.source import FITTED, GIVEN, DiagnosisInput, Series
from suite.diagnose.sources.view_source import NO_AGREEMENT, QUANTITIES, Shares, ViewSource

MEASURE = (
    "RMS over the axes of the residual of {about} on held-out flights [{unit}], as the mean of "
    "each flight less the mean of the reference flights"
)


@dataclass(frozen=True, kw_only=True)
class MeansSource(ViewSource):
    """Source for a change of the mean acceleration of whole flights since reference flights.

    Its noise floor is what an unchanged vehicle shows: how the means of the reference flights
    differ.
    """

    reference: ViewEvidence
    """The reference flights."""
    reason = NO_AGREEMENT
    block = 1  # means of flights are independent
    window = "means of whole flights"

    def _within(self, residual: np.ndarray, flight: np.ndarray) -> np.ndarray:
        """Return the means, from which nothing is subtracted."""
        return residual

    def _shares(self, found: SearchResult) -> Shares:
        """Return the shares that the named effects explain; a black box has nothing to explain."""
        before, after = (
            (self.held.residuals(at.theta).residual ** 2).mean(axis=0)
            for at in (found.start, found.estimate)
        )
        closed = 1.0 - after / np.maximum(before, TINY)
        return Shares(
            closed, np.maximum(closed, 0.0), np.zeros(3), before, self._repeatability(found)
        )

    def series(self, found: SearchResult) -> Series:
        """Return the mean of every reference flight and held-out flight, see `Source`.

        The axis is the one along which the named effects change the means most.
        """
        start, end = found.start.theta, found.estimate.theta
        earlier = _deviations(self.reference, start)
        change, left = (self.held.residuals(theta).residual for theta in (start, end))
        size = np.abs(change - left if found.named else change).mean(axis=0)
        axis = max(self.view.axes, key=lambda k: float(size[k]))
        count, zeros = len(earlier), np.zeros(len(earlier) + len(change))
        lines = {GIVEN: zeros}
        if found.named:
            named = zeros.copy()
            named[count:] = (change - left)[:, axis]
            lines[FITTED] = named
        quantity = QUANTITIES.get(self.name, self.name)
        return Series(
            1.0 + np.arange(len(zeros)),
            np.concatenate([earlier, change])[:, axis],
            lines,
            f"Change of the mean {quantity} along body {'xyz'[axis]} [{self.unit}]",
            f"Each point is the mean of a flight, less the mean of the {count} reference flights: "
            f"flights 1 to {count} are the reference flights, the others the held-out ones.",
            x_label="flight",
        )


@dataclass(frozen=True, kw_only=True)
class MotionSource(ViewSource):
    """Source for a change since reference flights that shows only in motion.

    It is the fallback of `MeansSource`: it is searched if no mean has changed.
    """

    reference: ViewEvidence
    """The reference flights, before the change."""
    fitted: ViewEvidence
    """The flights after the change."""
    views: int
    """Number of views that are searched; the search corrects for it."""

    def search(self, say: Callable[[str], None], seed: int) -> SearchResult:
        """Search for an effect that has changed since the reference flights, see `Source`."""
        found = search_motion_change(self.reference, self.fitted, self.candidates, self.views)
        return found or SearchResult((), self.start, self.begin, self.begin, [])


def since_reference(
    reference: ViewEvidence,
    evidence: ViewEvidence,
    held: ViewEvidence,
    spread: RotorSpread,
    allowed: Sequence[Candidate],
    means_only: bool,
    shared: dict[str, Any],
) -> ViewSource:
    """Return the source that searches for a change since the `reference` flights.

    `evidence` has the flights to fit, `held` the held-out ones. `spread` is how much the rotors'
    thrusts vary between the flights of one vehicle. With `means_only` there is no fallback.
    `shared` are fields of both sources.
    """
    begin = change_evidence(reference, evidence.flights, spread)
    theta = begin.at.theta
    shared = {**shared, "begin": begin, "names_small": True, "reference": reference}
    in_motion = MotionSource(
        candidates=allowed, held=held, fitted=evidence, views=len(spread.along), **shared
    )
    means = replace(less_reference_residual(reference, theta, held.flights), means=True)
    shared |= {
        "measure": MEASURE.format(about=shared["about"], unit=shared["unit"]),
        "floor": _spread_of_means(reference, theta),
    }
    return MeansSource(
        candidates=view_candidates(allowed, begin.block),
        held=means,
        fallback=None if means_only else in_motion,
        **shared,
    )


def _spread_of_means(reference: ViewEvidence, theta: np.ndarray) -> np.ndarray:
    """Return the standard deviation (3,) of a flight's mean less that of the reference flights.

    It is that of a flight of an unchanged vehicle, by axis. `theta` (P,) are the parameters.
    """
    deviations = _deviations(reference, theta)
    return deviations.std(axis=0, ddof=1) * np.sqrt(1.0 + 1.0 / len(deviations))


def _deviations(reference: ViewEvidence, theta: np.ndarray) -> np.ndarray:
    """Return the mean residual (F, 3) of each of F flights, less that of all flights."""
    data = reference.residuals(theta)
    means = means_of(data.residual, data.flight)
    return means - means.mean(axis=0)


def references_of(
    given: DiagnosisInput, flights: ViewFlights, evidence: Mapping[str, ViewEvidence]
) -> tuple[dict[str, ViewEvidence], RotorSpread | None, tuple[str, ...]]:
    """Prepare the reference flights, to be compared with `flights` and their `evidence` by view.

    Returns:
        Their evidence by view, the spread between flights, and a note for each unusable flight.

    Raises:
        ValueError: if less than two are usable, or their signals differ from the other flights'.
    """
    if not given.references:
        return {}, None, ()
    before = ready(given.references, given.vehicle, given.limits, given.logs)
    if len(before.names) < 2:
        raise ValueError(
            "; ".join(
                [
                    f"--reference has {len(before.names)} flight; at least 2 are needed, better 3, "
                    "to estimate how flights of one vehicle differ",
                    *before.notes,
                ]
            )
        )
    if before.views != flights.views or before.source != flights.source:
        raise ValueError(
            f"the reference flights are driven by {before.source} and allow "
            f"{_view_words(before)}, the others by {flights.source} and {_view_words(flights)}: "
            "log the same signals in both"
        )
    earlier = {n: replace(one, flights=before.smoothed[n]) for n, one in evidence.items()}
    return earlier, rotor_spread([*earlier.values(), *evidence.values()]), before.notes


def spread_words(spread: RotorSpread | None, count: int) -> tuple[str, ...]:
    """Return a text for people on how much the `count` reference flights differ, if any."""
    if spread is None:
        return ()
    return (
        f"The {count} reference flights differ as if each rotor's thrust varied by "
        f"{100 * spread.share:.1f} % from flight to flight ({spread.freedom} degrees of freedom). "
        "The differences along each axis count as well. A change is named if it exceeds these "
        "differences significantly.",
    )


def _view_words(flights: ViewFlights) -> str:
    """Return a text with the views of flights, their axes and the width of their windows."""
    return " and ".join(
        f"{view.name} (along {''.join('xyz'[k] for k in view.axes)}, means of {view.width_s:g} s)"
        for view in flights.views
    )
