"""The verdict and its reasons: gaps, structure in the remaining error, and wind."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.data.windows import STATE
from suite.diagnose.diagnose import Verdict, deciding, verdict_on
from suite.diagnose.sources.rollout_source import of_rollouts, structure_where
from suite.diagnose.sources.source import Remaining
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.disturbances import Swing, _likelihood, _range_of, find_turbulence
from suite.diagnose.verdict.gap import Gap, from_true_starts, gap_of, noise_floor, remaining_share
from suite.diagnose.verdict.residual_structure import (
    AXES,
    DisturbanceEquations,
    ResidualStructure,
    ShapeScore,
    disturbance_equations,
    residual_structure,
)


def slow_errors(size=1.0):
    """Return slow errors of 10 windows, those of velocity x larger by `size`, and the expected."""
    energy = np.full((10, STATE), 5.0)
    energy[:, 6] *= size
    return energy, np.full((10, STATE), 5.0)


def left(p_value=0.5, coloured=0.5):
    shapes = [ShapeScore("force with the speed", 1.0, p_value, ())]
    return ResidualStructure(shapes, dict.fromkeys(AXES, coloured))


def finding(drag, named=True, **remaining):
    """Return the finding of the shared diagnosis with another remaining error."""
    left = Remaining(**{"structured": False, "share": 0.0, **remaining})
    names = drag.main.names if named else ()
    return replace(drag.main, names=names, remaining=left)


def test_one_place_decides_by_names_structure_and_share(drag):
    def label(named, tested=False, **remaining):
        one = finding(drag, named, **remaining)
        return verdict_on([one], named or tested, THRESHOLDS).label

    some = {"structured": True, "where": "the speed"}
    assert label(False) == "no_gap" and label(True) == "named"
    assert label(False, tested=True) == "named", "a wind or a lag is a name as well"
    assert label(True, share=0.3, **some) == "partly"
    assert label(True, share=0.9, **some) == label(False, share=1.0, **some) == "unknown"


def test_sources_that_name_something_are_judged_and_a_swing_always_remains(drag):
    some = finding(drag, share=0.1)
    bare = finding(drag, False, structured=True, share=0.8, where="torque x")
    assert verdict_on([some, bare], True, THRESHOLDS) == Verdict("named", 0.1)
    assert verdict_on([bare], False, THRESHOLDS) == Verdict("unknown", 0.8, "torque x")
    swing = Swing(1.4, (1.3, 1.5), 0.5, 1e-6)
    verdict = verdict_on([finding(drag, share=0.1, swing=swing)], True, THRESHOLDS)
    assert verdict.label == "partly" and verdict.where == swing.words


def test_only_an_error_above_the_noise_decides(drag):
    """A large share of a small unexplained error decides nothing, and is no reason."""
    noisy = finding(drag, share=0.8, explainable=0.9, where="force x")
    clear = finding(drag, structured=True, share=0.2, where="torque y")
    assert verdict_on([noisy, clear], True, THRESHOLDS) == Verdict("partly", 0.2, "torque y")
    wrong = finding(drag, structured=True, share=0.8, where="torque y")
    right = finding(drag, share=0.02, explainable=0.9, where="force x")
    assert verdict_on([right, wrong], True, THRESHOLDS) == Verdict("unknown", 0.8, "torque y")
    assert deciding([right, wrong]) == [wrong] and deciding([right]) == [right]
    swing = Swing(1.4, (1.3, 1.5), 0.5, 1e-6)
    verdict = verdict_on([finding(drag, share=0.1, swing=swing, where="z")], True, THRESHOLDS)
    assert verdict.where == swing.words


def test_structure_is_a_shape_a_colour_or_the_largest_channel():
    quiet, loud = slow_errors(), slow_errors(3.0)
    assert structure_where(quiet, left(), False) is None
    assert structure_where(quiet, left(p_value=1e-4), False) == "force with the speed"
    coloured = structure_where(quiet, left(coloured=1e-6), False)
    assert coloured == ("a changing force along body x, y, z; a changing torque along body x, y, z")
    assert structure_where(loud, left(), False) == "errors of velocity x"
    # Rotor speeds as the input have noise of their own.
    assert structure_where(loud, left(coloured=1e-6), True) is None
    assert structure_where(loud, left(), True, replace(THRESHOLDS, structure_rotor_input=1.1))


def test_a_gap_has_its_interval_its_noise_floor_and_the_share_that_remains_of_it():
    before, after, none = (Gap(np.full(8, 1.0 + above), np.zeros(8), {}) for above in (24, 6, -0.1))
    assert (before.rms, after.rms) == (5.0, pytest.approx(np.sqrt(7.0)))
    assert remaining_share(before, after) == pytest.approx((7**0.5 - 1.0) / 4.0)
    assert remaining_share(after, before) == 1.0 and remaining_share(before, none) == 0.0
    rng = np.random.default_rng(0)
    energies = rng.chisquare(10, 80), rng.chisquare(10, 80) + 8.0
    before, after = (Gap(energy / 10.0, energy, {}) for energy in energies)
    low, high = before.ci95(0)
    assert low < before.rms < high and high - low < 0.3
    assert before.ci95(0) == before.ci95(0) != before.ci95(1)
    assert after.exceeds(before, 0.25, THRESHOLDS)
    assert not before.exceeds(after, 0.25, THRESHOLDS)
    assert not before.exceeds(before, 0.25, THRESHOLDS)
    assert not after.exceeds(before, 0.25, Thresholds(refuting_chi2=1e6))
    slope, noise = np.zeros((1, STATE, STATE)), np.zeros(STATE)
    slope[0, 0, 6], noise[[0, 6]] = 0.5, (0.3, 0.8)
    np.testing.assert_allclose(noise_floor(slope, noise)[0, [0, 6]], [0.5, 0.8])


def test_a_diagnosis_is_measured_on_what_was_held_out(drag, found_drag, flown):
    assert drag.label == "named" and drag.flights.driven_by == "commands"
    noise = of_rollouts(found_drag.search.last).noise
    linear = from_true_starts(flown.model, found_drag.theta, flown.held)
    again = gap_of(linear, flown.held, noise)
    np.testing.assert_array_equal(again.score, found_drag.after.score)
    assert found_drag.after.rms < 1.3 < found_drag.before.rms


def test_without_the_name_its_shape_is_left_and_a_drag_is_not_taken_for_wind(found_drag, flown):
    found, details = found_drag.search, found_drag.remaining.details
    evidence, bare = of_rollouts(found.last), found.estimate._replace(theta=flown.start.theta)
    windows = evidence.trusted
    equations, with_it = (
        disturbance_equations(flown.model, windows, evidence.whitening, one)
        for one in (bare, found.estimate)
    )
    fold = np.arange(len(windows.flight)) % 5
    with_gap = residual_structure(equations, fold)
    assert with_gap.shapes[0].gain > 10.0 * max(details["shapes"][0]["gain"], 1.0)
    assert min(with_gap.coloured.values()) < 1e-6 <= min(details["coloured"].values())
    assert find_turbulence(flown.model, found.estimate.theta, with_it) is None


def test_the_likelihood_of_a_random_disturbance_peaks_at_its_size():
    rng = np.random.default_rng(2)
    count, size = 200, 2.0
    hessian = np.broadcast_to(4.0 * np.eye(6), (count, 6, 6))
    noise = 2.0 * rng.standard_normal((count, 6))
    gradient = 4.0 * size * rng.standard_normal((count, 6)) + noise
    equations = DisturbanceEquations(hessian, gradient, None, None)  # type: ignore[arg-type]
    sizes = np.array([0.5, 1.0, 2.0, 4.0, 8.0])
    found = _likelihood(equations, np.broadcast_to(np.eye(6), (count, 6, 6)), sizes)
    assert sizes[found.argmax()] == size


def test_an_interval_at_the_end_of_the_tried_values_is_unknown():
    tried = np.array([1.0, 2.0, 4.0, 8.0])
    assert _range_of(tried, np.array([False, True, True, False])) == [2.0, 4.0]
    assert _range_of(tried, np.array([False, False, True, True])) is None
