"""A policy's trial beside the plan of its track."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eval.logs.flight import Flight
from eval.worlds.trial import TrialResult, TrialSpec
from suite.experiments.study.legs import Leg, legs

AROUND = 0.9
"""A leg on which the direction turns by so many circles has gone around."""
Flown = tuple[TrialResult, Flight]
"""How the judge saw a trial end, and the flight."""


class Lap(NamedTuple):
    """A policy's trial beside the plan of its track; without one of the two there is no ratio."""

    trial: TrialSpec
    planned_s: float | None
    """None where the judge has not seen the plan finish [s]."""
    policy_s: float | None
    """None where the policy has not finished [s]."""
    ratio: float | None
    """Policy over plan."""
    path: float | None
    """The same of the metres flown."""
    around: Leg | None
    """The policy's leg with the most turning."""


def beside(plan: Flown, mine: Flown) -> Lap:
    """Return a policy's trial beside the plan of its track."""
    (best, path), (result, flight) = plan, mine
    most = max(legs(flight), key=lambda leg: leg.turns, default=None)
    planned_s = best.time_s if best.success else None
    policy_s = result.time_s if result.success else None
    if planned_s is None or policy_s is None:
        return Lap(result.trial, planned_s, policy_s, None, None, most)
    ratio, far = policy_s / planned_s, length_m(flight) / length_m(path)
    return Lap(result.trial, planned_s, policy_s, ratio, far, most)


def length_m(flight: Flight) -> float:
    """Return how far a flight went [m]."""
    return float(np.linalg.norm(np.diff(flight.pos_w, axis=0), axis=-1).sum())


def goes_around(lap: Lap) -> bool:
    """Say whether the direction turned by a whole circle on the way to one gate."""
    return lap.around is not None and lap.around.turns >= AROUND
