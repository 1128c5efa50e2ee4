"""A new source of evidence is one class: here a thermometer's readings along flights."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from suite.diagnose.estimate.block import Block, Estimate, without_nuisance
from suite.diagnose.estimate.parameters import Candidate, FittedNumber, ParameterSpace
from suite.diagnose.evidence.evidence import Evidence
from suite.diagnose.search.search import search

NAMES = ("lapse_rate", "warm_motors", "sunshine")
SPACE = ParameterSpace(
    tuple(FittedNumber(name, "size", None, -5.0, 5.0, 0.0, 1.0) for name in NAMES), {}
)
AMONG = [Candidate(name, (k,), name) for k, name in enumerate(NAMES)]


@dataclass(frozen=True)
class Thermometer(Evidence):
    """Readings [K] of R rows of flights, as sums of what each number does; one level is free."""

    reading: np.ndarray
    does: np.ndarray
    flight: np.ndarray
    sigma: float = 1.0

    @property
    def space(self) -> ParameterSpace:
        return SPACE

    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> Block:
        along = list(range(len(NAMES)) if indices is None else indices)
        left, slope = self.reading - self.does @ at.theta, self.does[:, along]
        # The air's temperature on a day is a nuisance number.
        day = np.eye(self.flight.max() + 1)[self.flight]
        day = day @ np.linalg.pinv(day)
        left, slope = left - day @ left, slope - day @ slope
        stretch = np.arange(len(left)) // 10
        first = np.unique(stretch, return_index=True)[1]
        rows = (left[:, None] / self.sigma, slope[:, None] / self.sigma)
        return without_nuisance(*rows, along, stretch, self.flight[first], 1.0 * first)

    def weighed(self, at: Estimate) -> tuple[Evidence, Block]:
        found = replace(self, sigma=float(self.sigma * self.linearise(at).residual.std()))
        return found, found.linearise(at)


def readings(seed, **sizes):
    rng = np.random.default_rng(seed)
    does = rng.standard_normal((400, len(NAMES)))
    truth = np.array([sizes.get(name, 0.0) for name in NAMES])
    flight = np.repeat(np.arange(4), 100)
    level = 10.0 * rng.standard_normal(4)
    return Thermometer(does @ truth + level[flight] + rng.standard_normal(400), does, flight)


def test_a_toy_effect_is_named_with_its_size_and_interval():
    start = Estimate(SPACE.array("start"), np.zeros((0, 0)))
    found = search(readings(0, warm_motors=0.8), start, AMONG)
    (one,) = found.named
    assert one.candidate.name == "warm_motors" and one.p_value <= 0.001 and one.rivals == ()
    assert found.estimate.theta[1] == pytest.approx(0.8, abs=2.0 * found.half_widths()[0])
    assert found.half_widths()[0] < 0.2
    assert found.refitted(()).named == () and found.refitted(()).estimate.theta[1] == 0.0


def test_where_there_is_none_nothing_is_named():
    start = Estimate(SPACE.array("start"), np.zeros((0, 0)))
    named = [search(readings(seed), start, AMONG).named for seed in range(1, 6)]
    assert named == [()] * 5
