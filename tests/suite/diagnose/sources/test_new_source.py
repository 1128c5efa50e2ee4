"""A new source is a class of evidence and one that holds flights out: here a thermometer's."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from eval.effects import EFFECTS
from suite.common.report import html
from suite.diagnose.diagnose import SOURCES, diagnose
from suite.diagnose.estimate.block import Block, Estimate, without_nuisance
from suite.diagnose.estimate.parameters import Candidate, make_space
from suite.diagnose.evidence.evidence import Evaluation, Evidence
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.report.page import page
from suite.diagnose.sources.source import Remaining, Source, SourceSet
from suite.diagnose.thresholds import THRESHOLDS
from suite.diagnose.verdict import actuators
from suite.diagnose.verdict.gap import Channel, EffectSize, Gap, remaining_share
from tests.support.vehicles import PLAIN, with_effects
from tracks.common.files import plain

SPACE = make_space(PLAIN)
# The catalogue has no weather: these parameters stand for it.
NAMES = ("linear_drag", "constant_wind", "rotor_drag")
PLACES = [next(i for i, e in enumerate(SPACE.entries) if e.effect == name) for name in NAMES]
START = Estimate(SPACE.array("start"), np.zeros((0, 0)))


@dataclass(frozen=True)
class Thermometer(Evidence):
    """Readings [K] of R rows of flights, as sums of what each parameter does, and a level a day."""

    reading: np.ndarray
    does: np.ndarray
    flight: np.ndarray
    sigma: float = 1.0

    @property
    def space(self):
        return SPACE

    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> Block:
        along = list(range(len(SPACE.entries)) if indices is None else indices)
        residual = self.reading - self.does @ at.theta[PLACES]
        slope = np.zeros((len(residual), len(along)))
        for column, place in zip(self.does.T, PLACES, strict=True):
            if place in along:
                slope[:, along.index(place)] = column
        # The temperature of a day is a nuisance parameter.
        day = np.eye(self.flight.max() + 1)[self.flight]
        day = day @ np.linalg.pinv(day)
        residual, slope = residual - day @ residual, slope - day @ slope
        stretch = np.arange(len(residual)) // 10
        first = np.unique(stretch, return_index=True)[1]
        rows = (residual[:, None] / self.sigma, slope[:, None] / self.sigma)
        return without_nuisance(*rows, along, stretch, self.flight[first], 1.0 * first)

    def estimate_noise(self, at: Estimate) -> Evaluation:
        sigma = float(self.sigma * self.linearise(at).residual.std())
        return replace(self, sigma=sigma).relinearise(at)


@dataclass(frozen=True, kw_only=True)
class ThermometerSource(Source):
    """Flights with a thermometer, of which the last is held out."""

    held: Thermometer

    def gap(self, found, theta):
        error = self.held.linearise(Estimate(theta, np.zeros((0, 0)))).residual
        power = (error**2).mean(axis=1)
        rms = float(np.sqrt(power.mean()))
        return Gap(power, power, {self.name: {"air": Channel(rms, 1.0)}}, 1.0)

    def remaining(self, found, gaps, seed):
        return Remaining(gaps[1].rms > 1.5, remaining_share(*gaps), "the air's temperature")


class SizedSource(ThermometerSource):
    """The same, where only a wind is large enough to matter."""

    def sizes(self, found):
        sizes = {named.candidate.name: 0.01 for named in found.named} | {"constant_wind": 1.0}
        return {name: (EffectSize(size, 0.0, None),) * 2 for name, size in sizes.items()}


def sources(wind, drag=0.0, alike=0.0, rows=100, kind=ThermometerSource):
    """Return a source of four flights whose readings depend on `wind` times the second column.

    They depend on `drag` times the first one, which is `alike` the second.
    """
    rng = np.random.default_rng(0)
    does, flight = rng.standard_normal((4 * rows, len(NAMES))), np.repeat(np.arange(4), rows)
    does[:, 0] = alike * does[:, 1] + np.sqrt(1.0 - alike**2) * does[:, 0]
    level = 10.0 * rng.standard_normal(4)
    reading = does @ [drag, wind, 0.0] + level[flight] + rng.standard_normal(4 * rows)

    def part(rows):
        day = np.unique(flight[rows], return_inverse=True)[1]
        return Thermometer(reading[rows], does[rows], day)

    source = kind(
        name="air", about="temperatures", subject="temperature", unit="K off", measure="RMS [K]",
        horizon_s=1.0, begin=part(flight < 3).estimate_noise(START),
        candidates=[Candidate(name, (p,), name) for name, p in zip(NAMES, PLACES, strict=True)],
        limits=THRESHOLDS, held=part(flight == 3),
    )  # fmt: skip
    return SourceSet((source,), ("flight 4",), "the weather")


def test_rollouts_find_no_change(log):
    with pytest.raises(ValueError, match="rollouts cannot find a change since reference flights"):
        diagnose([], PLAIN, [log], by="rollouts")


def test_what_a_name_explains_is_computed_without_names_that_are_too_small(monkeypatch):
    given = sources(1.0, drag=0.5, alike=0.95, rows=300, kind=SizedSource)
    monkeypatch.setitem(SOURCES, "air", lambda _: given)
    (finding,) = diagnose([], PLAIN, by="air").findings
    assert [named.candidate.label for named in finding.names] == ["constant_wind"]
    # Nothing else remains, so without the wind the gap is as it was before.
    assert finding.without["constant_wind"].rms == pytest.approx(finding.before.rms, rel=1e-6)


@pytest.mark.parametrize("wind", [0.0, 0.8])
def test_an_effect_of_a_separate_test_leaves_no_unknown(monkeypatch, wind):
    class LeftSource(ThermometerSource):
        """The same, where most of the error always remains."""

        def remaining(self, found, gaps, seed):
            return Remaining(True, 1.0, "the air's temperature")

    values = EFFECTS["motor_lag"].values(0.05)
    lag = actuators.TestedEffect("motor_lag", values, {}, 0.9, 1e-4, "commands")
    given = replace(sources(wind, kind=LeftSource), tested=(lag,))
    monkeypatch.setitem(SOURCES, "air", lambda _: given)
    found = diagnosis_json(diagnose([], PLAIN, by="air"))
    assert [effect["name"] for effect in found["effects"]] == ["motor_lag"]
    assert found["verdict"] == "partly"


@pytest.mark.parametrize(
    ("own", "label"), [(None, "named"), ((2.0, 5.0), "named"), ((0.85, 4.0), "no_gap")]
)
def test_a_random_wind_that_the_file_has_is_not_named_again(monkeypatch, own, label):
    class WindySource(ThermometerSource):
        """The same, where random wind explains the error."""

        def remaining(self, found, gaps, seed):
            spans = (("intensity", 0.8, [0.7, 0.9]), ("length", 5.0, [3.0, 7.0]))
            values = {n: {"value": value, "unit": "", "ci95": span} for n, value, span in spans}
            gusts = EFFECTS["gusts"].values(0.8, 5.0)
            wind = actuators.TestedEffect("gusts", gusts, values, None, 1e-5, self.name)
            return Remaining(False, 1.0, wind=wind)

    monkeypatch.setitem(SOURCES, "air", lambda _: sources(0.0, kind=WindySource))
    vehicle = with_effects(PLAIN, gusts=own) if own else PLAIN
    result = diagnose([], vehicle, by="air")
    found = diagnosis_json(result)
    assert found["verdict"] == label and len(found["effects"]) == (label == "named")
    kept = result.vehicle.effects["gusts"].intensity
    assert kept == (0.8 if label == "named" else 0.85)


@pytest.mark.parametrize(("size", "views"), [(0.8, ["air"]), (0.0, ["air", "water"])])
def test_no_gap_lists_all_views_that_were_examined(monkeypatch, size, views):
    (air,) = sources(size).sources
    (water,) = sources(0.0).sources
    given = SourceSet((air, replace(water, name="water")), ("flight 4",), "the weather")
    monkeypatch.setitem(SOURCES, "air", lambda _: given)
    found = diagnosis_json(diagnose([], PLAIN, by="air"))
    assert (found["verdict"], found["views"]) == ("named" if size else "no_gap", views)


@pytest.mark.parametrize(("size", "label"), [(0.8, "named"), (0.0, "no_gap")])
def test_a_new_source_goes_through_the_whole_diagnosis(monkeypatch, size, label):
    monkeypatch.setitem(SOURCES, "air", lambda given: sources(size))
    result = diagnose([], PLAIN, by="air")
    found = plain(diagnosis_json(result))
    assert found["verdict"] == label and found["gap"]["held_out"] == ["flight 4"]
    assert found["gap"]["channels"]["air"]["air"]["noise_floor"] == 1.0
    text = html(page(result, found, "", set()))
    assert "temperature" in text and "The evidence" in text
    assert len(found["effects"]) == (size > 0.0)
    for effect in found["effects"]:
        assert (effect["name"], effect["view"]) == ("constant_wind", "air")
        assert effect["gap_removed"] > 0.9 and found["gap"]["after"] < 1.1 < found["gap"]["before"]
        search = result.main.search
        (one,), (half_width,) = search.named, search.half_widths()
        assert one.p_value <= 0.001 and one.rivals == () and half_width < 0.2
        named = result.vehicle.effects["constant_wind"].velocity[0]
        assert named == pytest.approx(size, abs=2.0 * half_width)
        without = search.refitted(())
        assert without.named == () and (without.estimate.theta == START.theta).all()
