"""The search on sums whose truth is known: solutions, intervals, p-values, composites, delays."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.stats import kstest

from suite.diagnose.estimate import composites
from suite.diagnose.estimate.block import Block, Estimate, normal_equations
from suite.diagnose.estimate.gauss_newton import chi2_fall, intervals95, solve
from suite.diagnose.estimate.parameters import ParameterSpace, candidates, effects_in, make_space
from suite.diagnose.evidence.evidence import Evaluation, Evidence, flights_agree
from suite.diagnose.search import search as searching
from suite.diagnose.search.evaluation import NamedEffect, cross_validated_chi2, linear_change
from suite.diagnose.search.search import (
    SearchTask,
    _p_value_at_fit,
    _Trial,
    could_be_best,
    needs_all_parts,
    search,
)
from suite.diagnose.thresholds import THRESHOLDS
from tests.support.vehicles import PLAIN

SPACE = make_space(PLAIN)
START, LOW, HIGH, STEP = (SPACE.array(name) for name in ("start", "low", "high", "step"))
SINGLE, COMMANDED = (candidates(SPACE, False, inputs) for inputs in ((), {"command"}))
WHOLE = {one.name: one for one in composites.composites(SINGLE)}
WIND, PAYLOAD = WHOLE["constant_wind + linear_drag"], WHOLE["mass_offset + com_offset"]
NAMES = ("linear_drag", "rotor_drag", "thrust_scale", "gyro_bias", "com_offset", "frame_tilt")
AMONG = [one for one in COMMANDED if one.name in NAMES]
MIDDLE, WINDOWS, ROWS = 0.5 * (LOW + HIGH), 20, 12
FOLD = np.arange(20) % 5


def places(effect):
    return [i for i, entry in enumerate(SPACE.entries) if entry.effect == effect]


def test_bounds_hold_and_the_free_solution_is_exact():
    square, cross = np.array([[4.0, 1.0], [1.0, 3.0]]), np.array([1.0, -2.0])
    wide, scale = np.full(2, 10.0), np.ones(2)
    exact = np.linalg.solve(square, cross)
    np.testing.assert_allclose(solve(square, cross, -wide, wide, scale), exact, rtol=1e-6)
    bound = solve(square, cross, np.array([-10.0, 0.0]), wide, scale)
    np.testing.assert_allclose(bound, [0.25, 0.0], atol=1e-6)
    for hessian, gradient in ((square * np.nan, cross), (square, cross * np.inf)):
        with pytest.raises(ValueError, match="not finite"):
            solve(hessian, gradient, -wide, wide, scale)


def remaining(slope, residual, flight=None):
    """Return the solution, and the normal equations of what it leaves."""
    made = normal_equations(slope, residual[..., 0], flight)
    best = np.linalg.solve(*made.sums())
    return best, made._replace(gradient=made.gradient - made.hessian @ best)


def test_intervals_hold_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(1)
    inside = []
    for _ in range(100):
        slope = rng.standard_normal((30, 20, 2))
        residual = (slope @ [0.3, -0.2])[..., None] + rng.standard_normal((30, 20, 1))
        best, left = remaining(slope, residual)
        inside.extend(np.abs(best - [0.3, -0.2]) < intervals95(left).half_width)
    # Of 200, 190 are expected inside; fewer than 180 come with a chance of 0.1 %.
    assert sum(inside) >= 180


def test_intervals_by_flights_hold_the_truth_however_many_parameters_are_fitted():
    """An error that comes back in every window of a flight: 4 flights, 3 parameters.

    By the flights' slopes alone 80 % of the intervals hold the truth.
    """
    rng, flight = np.random.default_rng(2), np.repeat(np.arange(4), 5)
    windows, flights = [], []
    for _ in range(400):
        slope = rng.standard_normal((4, 1, 3))[flight] + 0.5 * rng.standard_normal((20, 40, 3))
        residual = rng.standard_normal((20, 40, 1)) + rng.standard_normal((4, 1, 1))[flight]
        best, left = remaining(slope, residual, flight)
        windows.append(np.abs(best) <= intervals95(left).half_width)
        flights.append(np.abs(best) <= intervals95(left, 1.0).half_width)
    assert np.mean(windows) < 0.7 and 0.93 < np.mean(flights) < 0.99


def equations(rng, colour=0.0, truth=None, size=0.0, alike=0.0, misfit=0.0):
    """Return normal equations of noise, plus `size` of what `truth` does in each window.

    One row's noise has the correlation `colour` with the next one; other effects have the share
    `alike` of the slope of `truth`. The model has an error like `thrust_scale`, in each window of
    another size, with the standard deviation `misfit`.
    """
    count = len(SPACE.entries)
    slope = rng.standard_normal((WINDOWS, ROWS, count))
    noise = rng.standard_normal((WINDOWS, ROWS))
    for row in range(1, ROWS):
        noise[:, row] = colour * noise[:, row - 1] + np.sqrt(1 - colour**2) * noise[:, row]
    if truth is not None:
        true = next(c for c in AMONG if c.name == truth).indices[0]
        slope += alike * slope[..., true, None] * (np.arange(count) != true)
        noise = noise + size * slope[..., true]
    (scale,) = places("thrust_scale")
    noise = noise + misfit * rng.standard_normal((WINDOWS, 1)) * slope[..., scale]
    return normal_equations(slope / STEP, noise)


def scores_of(made, named=(), among=AMONG, seed=0):
    """Return the scores of candidates by the normal equations `made`."""
    evidence: Any = SimpleNamespace(space=SPACE, limits=THRESHOLDS, folds=lambda block: FOLD)
    return Evidence.scores(evidence, at_middle(made, evidence), named, among, seed)


def at_middle(made, evidence=None, flight=None):
    """Return an evaluation with the normal equations `made`."""
    block: Any = SimpleNamespace(equations=made, flight=flight)
    given: Any = evidence or SimpleNamespace(space=SPACE)
    return Evaluation(given, Estimate(MIDDLE), block)


def best_of(draws, named=(), among=AMONG, **options):
    """Return the best score of each of `draws` made data sets."""
    made = (equations(np.random.default_rng([7, k]), **options) for k in range(draws))
    return [scores_of(one, named, among, seed=k)[0] for k, one in enumerate(made)]


def test_p_values_of_coloured_noise_are_uniform():
    found = best_of(50, colour=0.9)
    p_values = np.array([one.p_value for one in found])
    assert kstest(p_values, "uniform").pvalue > 0.005
    # Of 50 nulls 0.5 are expected at or below 1 %; 4 or more come with a chance of 0.2 %.
    assert np.sum(p_values <= 0.01) < 4
    assert sum(one.gain > one.chance for one in found) < 4, "one null in a hundred exceeds it"


def test_the_true_effect_wins_over_one_that_looks_like_it_which_adds_nothing_to_it():
    found = best_of(10, truth="rotor_drag", size=0.6, alike=1.0)
    # Gains on data left out are noisy; what looks alike is told apart by whole fits afterwards.
    assert sum(one.candidate.name == "rotor_drag" for one in found) >= 9
    assert max(one.p_value for one in found) <= 0.01
    least = 1.0 / (1 + THRESHOLDS.sign_draws)  # the record itself is one of the draws
    assert min(one.p_value for one in found) >= least * (1.0 - 1e-9)
    true = next(c for c in AMONG if c.name == "rotor_drag")
    others, named = [c for c in AMONG if c != true], list(true.indices)
    found = best_of(10, named, others, truth="rotor_drag", size=0.6, alike=1.0)
    # The null shuffles the named effect's own part as well, which makes it the more careful.
    assert sum(one.p_value <= 0.01 for one in found) < 2


def test_an_error_of_the_model_like_one_effect_hides_no_other():
    for k in range(5):
        made = equations(np.random.default_rng([9, k]), truth="rotor_drag", size=0.6, misfit=2.0)
        p_values = {one.candidate.name: one.p_value for one in scores_of(made, seed=k)}
        assert p_values["rotor_drag"] <= 0.001 and p_values["thrust_scale"] > 0.01


def test_other_seeds_draw_another_null_and_one_seed_the_same():
    made = equations(np.random.default_rng(1))
    first, again, other = (scores_of(made, seed=seed) for seed in (1, 1, 2))
    assert first == again
    assert [s.gain for s in first] == [s.gain for s in other]
    assert first[0].chance != other[0].chance


def test_a_composite_has_the_parameters_of_all_its_parts():
    assert effects_in(WIND.name) == ("constant_wind", "linear_drag")
    assert list(WIND.indices) == sorted(places("constant_wind") + places("linear_drag"))
    assert [part.name for part in WIND.parts] == list(effects_in(WIND.name))
    without_drag = composites.composites([one for one in SINGLE if one.name != "linear_drag"])
    assert WIND.name not in {one.name for one in without_drag}
    assert composites.acts_through(WIND) and not composites.acts_through(PAYLOAD)


def test_a_wind_gets_slopes_of_a_usual_drag_only_where_no_drag_passes_it_on():
    theta, acts = START.copy(), np.ones(len(START), bool)
    assert composites.inactive_at(SPACE, theta, [WIND], acts) is None
    acts[places("constant_wind")] = False
    found = composites.inactive_at(SPACE, theta, [WIND], acts)
    assert found is not None and list(found[0]) == places("constant_wind")
    np.testing.assert_allclose(found[1][places("linear_drag")], 0.35)
    assert composites.inactive_at(SPACE, theta, SINGLE, acts) is None
    theta[places("constant_wind")[0]] = 1.0
    assert composites.inactive_at(SPACE, theta, [WIND], acts) is None


@pytest.mark.parametrize("drag_change", [0.7, pytest.param(-0.5, id="hovering flights need none")])
def test_a_fit_begins_where_drag_times_wind_is_that_of_the_linear_fit(drag_change):
    drag, wind = places("linear_drag"), places("constant_wind")
    change = np.zeros(len(START))
    change[drag], change[wind] = drag_change, 2.0
    begin = composites.begin_of(SPACE, START, WIND, wind, change, np.ones(len(START)))
    assert begin[drag].min() > 0.0
    assert begin[drag] * begin[wind] == pytest.approx(composites.usual_size(SPACE)[drag] * 2.0)


def test_a_linear_fit_of_a_composite_uses_the_second_columns_of_its_inactive_part():
    size, wind = len(START), tuple(places("constant_wind"))
    slope = np.random.default_rng(0).standard_normal((5, 40, size + 3)) / [*STEP, 1.0, 1.0, 1.0]
    slope[..., list(wind)] = 0.0
    residual = slope[..., size:] @ [1.0, -2.0, 0.5]
    made = normal_equations(slope, residual, along=(*range(size), *wind))
    assert tuple(made.columns_of(WIND.parts[0])) == wind
    assert sorted(made.along[c] for c in made.columns_of(WIND)) == list(WIND.indices)
    named: Any = SimpleNamespace(space=SPACE, theta=START, equations=made)
    change, information = linear_change(Evaluation(named, named, named), [], WIND)
    np.testing.assert_allclose(change[list(wind)], [1.0, -2.0, 0.5], atol=1e-3)
    assert (information[list(wind)] > 0.0).all() and not information[places("frame_tilt")].any()


def test_lines_name_effects_that_belong_together_and_composites_among_alternatives():
    assert composites.in_words([("linear_drag", "rotor_drag"), ("mass_offset",)]) == []
    (both,) = composites.in_words([("constant_wind",), ("linear_drag",)])
    assert "belong together" in both
    (one,) = composites.in_words([("frame_tilt", "thrust_tilt", WIND.name)])
    assert one.startswith(WIND.name) and "one hypothesis" in one


@pytest.mark.parametrize(
    ("sizes", "agree"), [([0.3, 0.25, 0.35, 0.3], True), ([1.5, -0.4, -0.4, 0.3], False)]
)
def test_flights_agree_on_what_all_of_them_have(sizes, agree):
    flight, rng = np.repeat(np.arange(4), 6), np.random.default_rng(0)
    slope = rng.standard_normal((24, 40, len(START))) / STEP
    residual = 0.1 * rng.standard_normal((24, 40))
    residual += np.array(sizes)[flight, None] * slope[..., 0] * STEP[0]
    made = normal_equations(slope, residual)
    assert chi2_fall(made, MIDDLE, SPACE, [0]) > 10.0 > chi2_fall(made, MIDDLE, SPACE, []) == 0.0
    current = at_middle(made, flight=flight)
    without, with_it = (cross_validated_chi2(current, at) for at in ([1], [0, 1]))
    assert flights_agree(without - with_it) == agree


def test_flights_disagree_where_one_of_them_decides():
    assert not flights_agree(np.array([100.0, 0.5, 0.2, -3.0]))
    assert flights_agree(np.array([5.0, -1.0])), "two flights are too few to judge"


def test_several_effects_have_to_explain_more_than_each_of_them_alone():
    mass, com = PAYLOAD.parts
    chi2 = {PAYLOAD: 100.0, mass: 105.0, com: 300.0}
    assert [one for one in chi2 if needs_all_parts(chi2, one, THRESHOLDS)] == [mass, com]
    assert needs_all_parts({**chi2, PAYLOAD: 90.0}, PAYLOAD, THRESHOLDS)
    falls = {PAYLOAD: 100.0, mass: 95.0, com: 10.0}
    assert not could_be_best(falls, PAYLOAD, THRESHOLDS)
    assert could_be_best({**falls, mass: 50.0}, PAYLOAD, THRESHOLDS)


BEGIN = Estimate(START, np.zeros((0, 0)))
(DELAY,), (GAIN, *_) = places("command_delay"), places("rate_gain")
TIME_S, COUNT = np.arange(0.0, 1.0, 5e-3), 12


@dataclass(frozen=True)
class Response(Evidence):
    """Response of 12 windows that follows commands at once, with a gain and a delay."""

    fine_s: np.ndarray
    command: np.ndarray
    measured: np.ndarray
    parameters: ParameterSpace = SPACE

    @property
    def space(self):
        return self.parameters

    def response(self, delay: float) -> np.ndarray:
        return np.array([np.interp(TIME_S - delay, self.fine_s, one) for one in self.command])

    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> Block:
        along = tuple(range(len(SPACE.entries)) if indices is None else indices)
        delay, gain = at.theta[[DELAY, GAIN]]
        response = self.response(delay)
        slope = np.zeros((*response.shape, len(along)))
        rate = (self.response(delay + 1e-3) - self.response(delay - 1e-3)) / 2e-3
        for place, column in ((DELAY, gain * rate), (GAIN, response)):
            if place in along:
                slope[..., along.index(place)] = column
        windows, none = np.arange(COUNT), np.zeros((COUNT, 0))
        return Block(
            (self.measured - gain * response) / 0.1, slope / 0.1, along,
            windows % 4, 1.0 * (windows // 4), none, none[..., None] + np.zeros(len(along)),
        )  # fmt: skip

    def estimate_noise(self, at: Estimate) -> Evaluation:
        return self.relinearise(at)


def test_a_delay_longer_than_a_jump_is_named_and_not_a_lower_gain():
    rng, fine_s = np.random.default_rng(0), np.arange(-0.2, 1.2, 1e-3)
    command = gaussian_filter1d(rng.standard_normal((COUNT, len(fine_s))), 8.0)
    command /= command.std()
    flown = Response(fine_s, command, np.zeros((COUNT, len(TIME_S))))
    noise = 0.1 * rng.standard_normal(flown.measured.shape)
    flown = replace(flown, measured=flown.response(0.03) + noise)
    among = [c for c in COMMANDED if {DELAY, GAIN} & {*c.indices}]

    found = search(flown.relinearise(BEGIN), among)
    assert [one.label for one in found.candidates] == ["command_delay"]
    assert abs(found.estimate.theta[DELAY] - 0.03) < 1e-3
    # The tangent at no delay leads into another minimum.
    entries = tuple(replace(entry, tried=()) for entry in SPACE.entries)
    flown = replace(flown, parameters=replace(SPACE, entries=entries))
    stuck = search(flown.relinearise(BEGIN), among)
    assert "command_delay" not in [one.label for one in stuck.candidates]


class Bent(Response):
    """Readings that move by x `command` in the end, but set out in another direction."""

    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> Block:
        block = super().linearise(at, indices)
        x = at.theta[DELAY] / 0.03
        moved = x * self.command + 10.0 * x * (1.0 - x) * self.fine_s
        slope = np.zeros((*moved.shape, len(block.along)))
        if DELAY in block.along:
            along = self.command + 10.0 * (1.0 - 2.0 * x) * self.fine_s
            slope[..., block.along.index(DELAY)] = along / 0.03
        return replace(block, residual=self.measured - moved, slope=slope)

    def response(self, delay: float) -> np.ndarray:
        return self.measured


def test_a_fitted_effect_is_tested_at_its_fit_where_its_slopes_hold(monkeypatch):
    """At the start they explain a hundredth of what the effect does."""
    command, away, noise = np.random.default_rng(0).standard_normal((3, COUNT, 20))
    entries = tuple(replace(entry, tried=()) for entry in SPACE.entries)
    flown = Bent(away, command, command + noise, replace(SPACE, entries=entries))
    (delay,) = [c for c in COMMANDED if c.indices == (DELAY,)]
    current = flown.relinearise(BEGIN)
    (score,) = flown.scores(current, [], [delay], 0)
    assert score.p_value > THRESHOLDS.name_p_value
    theta = START.copy()
    theta[DELAY] = 0.03
    trial = _Trial(0.0, NamedEffect(delay, score.p_value, 0.0), Estimate(theta, BEGIN.free))
    task = SearchTask([delay], lambda _: None, 0)
    assert _p_value_at_fit(task, current, [], [delay], trial) <= THRESHOLDS.name_p_value
    # The name that stays has the p-value of this test.
    monkeypatch.setattr(searching, "fit_with", lambda *_: flown.relinearise(trial.at))
    (kept,), _ = searching._replace_or_drop(task, flown, trial.at, [trial.name], 0, [delay])
    assert kept.candidate == delay and kept.p_value <= THRESHOLDS.name_p_value
