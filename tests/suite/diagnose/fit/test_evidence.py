"""A new source is a class of evidence and one that holds flights out: here a thermometer's."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from suite.common.report import html
from suite.diagnose.diagnose import SOURCES, diagnose
from suite.diagnose.estimate.block import Block, Estimate, without_nuisance
from suite.diagnose.estimate.parameters import (
    Candidate,
    FittedNumber,
    ParameterSpace,
    make_space,
)
from suite.diagnose.evidence.evidence import Evidence
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.report.page import page
from suite.diagnose.search.search import search
from suite.diagnose.sources.source import Remaining, Source, SourceSet
from suite.diagnose.thresholds import THRESHOLDS
from suite.diagnose.verdict.gap import Channel, Gap, remaining_share
from tests.support.vehicles import PLAIN
from tracks.common.files import plain

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

    def estimate_noise(self, at: Estimate) -> tuple[Evidence, Block]:
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


@dataclass(frozen=True, kw_only=True)
class ThermometerSource(Source):
    """Flights with a thermometer, of which the last is held out."""

    held: Thermometer

    def gap(self, found, theta):
        error = self.held.linearise(Estimate(theta, np.zeros((0, 0)))).residual
        rms = float(np.sqrt((error**2).mean()))
        power = (error**2).mean(axis=1)
        return Gap(power, power, {self.name: {"air": Channel(rms, 1.0)}}, 1.0)

    def remaining(self, found, gaps, seed):
        return Remaining(gaps[1].rms > 1.5, remaining_share(*gaps), "the air's temperature")


# The catalogue has no weather: its names stand for the toy's.
KNOWN = ("linear_drag", "constant_wind", "rotor_drag")


def as_sources(made):
    space = make_space(PLAIN)
    places = [next(i for i, e in enumerate(space.entries) if e.effect == name) for name in KNOWN]

    @dataclass(frozen=True)
    class Named(Thermometer):
        """The same readings, along numbers of the catalogue."""

        @property
        def space(self):
            return space

        def linearise(self, at, indices=None):
            along = list(range(len(space.entries)) if indices is None else indices)
            block = super().linearise(at._replace(theta=at.theta[places]))
            slope = np.zeros((*block.residual.shape, len(along)))
            for k, place in enumerate(places):
                if place in along:
                    slope[..., along.index(place)] = block.slope[..., k]
            free = np.zeros((len(slope), 0, len(along)))
            return replace(block, slope=slope, along=tuple(along), free_slope=free)

    def part(rows):
        flight = np.unique(made.flight[rows], return_inverse=True)[1]
        return Named(made.reading[rows], made.does[rows], flight)

    start = Estimate(space.array("start"), np.zeros((0, 0)))
    fitted = part(made.flight < 3)
    source = ThermometerSource(
        name="air", about="temperatures", subject="temperature", unit="K off", measure="RMS [K]",
        horizon_s=1.0, weighed=fitted.estimate_noise(start), start=start,
        candidates=[Candidate(name, (p,), name) for name, p in zip(KNOWN, places, strict=True)],
        limits=THRESHOLDS, held=part(made.flight == 3),
    )  # fmt: skip
    return SourceSet((source,), ("flight 4",), "the weather")


@pytest.mark.parametrize(("size", "label"), [(0.8, "named"), (0.0, "no_gap")])
def test_a_toy_source_goes_through_the_whole_diagnosis(monkeypatch, size, label):
    made = as_sources(readings(0, warm_motors=size))
    monkeypatch.setitem(SOURCES, "air", lambda given, before: made)
    result = diagnose([], PLAIN, by="air")
    found = plain(diagnosis_json(result))
    assert found["verdict"] == label and found["gap"]["held_out"] == ["flight 4"]
    assert found["gap"]["channels"]["air"]["air"]["noise_floor"] == 1.0
    text = html(page(result, found, "", set()))
    assert "temperature" in text and "The evidence" in text
    if size:
        (effect,) = found["effects"]
        assert (effect["name"], effect["view"]) == ("constant_wind", "air")
        assert effect["gap_removed"] > 0.9 and found["gap"]["after"] < 1.1 < found["gap"]["before"]
        assert result.vehicle.effects["constant_wind"].velocity[0] == pytest.approx(0.8, abs=0.2)
