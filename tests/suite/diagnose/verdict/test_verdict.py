"""The verdict and its reasons: what counts, what held-out flights confirm, what remains."""

from copy import copy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suite.diagnose.data.windows import STATE
from suite.diagnose.diagnose import Verdict, main_of, verdict_on
from suite.diagnose.estimate.parameters import Candidate
from suite.diagnose.estimate.permutation import CandidateScore
from suite.diagnose.search.evaluation import NamedEffect
from suite.diagnose.sources.examine import confirmed, examine, relevant_part
from suite.diagnose.sources.rollout_source import of_rollouts, structure_where
from suite.diagnose.sources.source import TOGETHER, TOO_SMALL, Remaining
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict import gap as gaps
from suite.diagnose.verdict import residual_structure as structure
from suite.diagnose.verdict.disturbances import Swing, _likelihood, _range_of, find_turbulence


def slow_errors(size=1.0):
    """Return slow errors of 10 windows, those of velocity x larger by `size`, and the expected."""
    energy = np.full((10, STATE), 5.0)
    energy[:, 6] *= size
    return energy, np.full((10, STATE), 5.0)


def left(p_value=0.5, coloured=0.5, force=1.0):
    shape = Candidate("force with the speed", (), "force with the speed")
    shapes = [CandidateScore(shape, 1.0, p_value, 0.0)]
    size = gaps.EffectSize(force, 0.0, None)
    return structure.ResidualStructure(shapes, dict.fromkeys(structure.AXES, coloured), size)


SWING = Swing(1.4, (1.3, 1.5))
SWUNG = Verdict("partly", 0.1, SWING.words)
SPEED = {"structured": True, "where": "the speed"}
TORQUE = {"structured": True, "where": "torque y"}
BELOW = {"share": 0.8, "explainable": 0.9, "where": "force x"}
"""A large share of a small unexplained error, which decides nothing and is no reason."""


@pytest.mark.parametrize(
    ("named", "remaining", "verdict"),
    [
        ([False], [{}], Verdict("no_gap", 0.0)),
        ([True], [{}], Verdict("named", 0.0)),
        ([True], [{"share": 0.3, **SPEED}], Verdict("partly", 0.3, "the speed")),
        ([True], [{"share": 0.9, **SPEED}], Verdict("unknown", 0.9, "the speed")),
        ([False], [{"share": 1.0, **SPEED}], Verdict("unknown", 1.0, "the speed")),
        # Sources that name something are judged, and a swing always remains.
        ([True, False], [{"share": 0.1}, {"share": 0.8, **TORQUE}], Verdict("named", 0.1)),
        ([True], [{"share": 0.1, "swing": SWING}], SWUNG),
        ([True], [{"share": 0.1, "swing": SWING, "where": "z"}], SWUNG),
        # Only an error above the noise decides.
        ([True] * 2, [BELOW, {"share": 0.2, **TORQUE}], Verdict("partly", 0.2, "torque y")),
        ([True] * 2, [BELOW, {"share": 0.8, **TORQUE}], Verdict("unknown", 0.8, "torque y")),
    ],
)
def test_one_place_decides_by_names_structure_and_share(drag, named, remaining, verdict):
    names = [drag.main.names if one else () for one in named]
    left = [Remaining(**{"structured": False, "share": 0.0, **one}) for one in remaining]
    pairs = zip(names, left, strict=True)
    findings = [replace(drag.main, names=one, remaining=rest) for one, rest in pairs]
    assert verdict_on(findings, any(named), THRESHOLDS) == verdict
    # A wind or a lag is a name as well.
    label = "named" if verdict.label == "no_gap" else verdict.label
    assert verdict_on(findings, True, THRESHOLDS).label == label


def test_the_reported_gap_is_of_a_name_or_else_of_what_is_more_than_noise(drag):
    quiet, loud = Remaining(False, 0.0, explainable=0.4), Remaining(True, 1.0, explainable=0.0)
    nameless = replace(drag.main, names=())
    torque, force = (replace(nameless, remaining=one) for one in (quiet, loud))
    named = replace(drag.main, remaining=quiet)
    assert main_of([torque, force]) is force is main_of([force, torque])
    assert main_of([force, named]) is named


def test_structure_is_a_shape_a_colour_or_the_largest_channel():
    quiet, loud = slow_errors(), slow_errors(3.0)
    assert structure_where(quiet, left(), False) is None
    assert structure_where(quiet, left(p_value=1e-4), False) == "force with the speed"
    assert structure_where(quiet, left(p_value=1e-4, force=0.04), False) is None, "too small"
    coloured = structure_where(quiet, left(coloured=1e-6), False)
    assert coloured == ("a changing force along body x, y, z; a changing torque along body x, y, z")
    assert structure_where(loud, left(), False) == "errors of velocity x"
    # Rotor speeds as the input have noise of their own.
    assert structure_where(loud, left(coloured=1e-6), True) is None
    assert structure_where(loud, left(), True, replace(THRESHOLDS, structure_rotor_input=1.1))


def test_a_gap_has_its_interval_its_noise_floor_and_the_share_that_remains_of_it():
    none = np.zeros(8)
    before, after, small = (gaps.Gap(none + score, none, {}) for score in (25.0, 7.0, 0.9))
    assert (before.rms, after.rms) == (5.0, pytest.approx(np.sqrt(7.0)))
    assert gaps.remaining_share(before, after) == pytest.approx((7**0.5 - 1.0) / 4.0)
    assert gaps.remaining_share(after, before) == 1.0 and gaps.remaining_share(before, small) == 0.0
    energies = np.random.default_rng(0).chisquare(10, (2, 80)) + [[0.0], [8.0]]
    before, after = (gaps.Gap(energy / 10.0, energy, {}) for energy in energies)
    low, high = before.ci95(0) or (0.0, 0.0)
    assert low < before.rms < high and high - low < 0.3
    assert before.ci95(0) == before.ci95(0) != before.ci95(1)
    assert after.exceeds(before, 0.25, THRESHOLDS)
    assert not before.exceeds(after, 0.25, THRESHOLDS)
    assert not before.exceeds(before, 0.25, THRESHOLDS)
    assert not after.exceeds(before, 0.25, Thresholds(refuting_chi2=1e6))
    slope, noise = np.zeros((1, STATE, STATE)), np.zeros(STATE)
    slope[0, 0, 6], noise[[0, 6]] = 0.5, (0.3, 0.8)
    np.testing.assert_allclose(gaps.noise_floor(slope, noise)[0, [0, 6]], [0.5, 0.8])


def test_a_diagnosis_is_measured_on_what_was_held_out(drag, found_drag, flown):
    assert drag.verdict.label == "named" and drag.flights.driven_by == "commands"
    linear = gaps.from_true_starts(flown.model, found_drag.theta, flown.held)
    again = gaps.gap_of(linear, of_rollouts(found_drag.search.last).noise)
    np.testing.assert_array_equal(again.score, found_drag.after.score)
    assert found_drag.after.rms < 1.3 < found_drag.before.rms


def test_without_the_name_its_shape_is_left_and_a_drag_is_not_taken_for_wind(found_drag, flown):
    found, details = found_drag.search, found_drag.remaining.details
    evidence, bare = of_rollouts(found.last), found.estimate._replace(theta=flown.start.theta)
    windows = evidence.trusted
    equations, with_it = (
        structure.disturbance_equations(evidence, windows, one) for one in (bare, found.estimate)
    )
    with_gap = structure.residual_structure(equations, np.arange(len(windows.flight)) % 5)
    assert with_gap.shapes[0].gain > 10.0 * max(details["shapes"][0]["gain"], 1.0)
    assert min(with_gap.coloured.values()) < 1e-6 <= min(details["coloured"].values())
    assert find_turbulence(flown.model, found.estimate.theta, with_it) is None


def test_a_random_disturbance_has_its_size_or_none_at_the_end_of_the_tried_values():
    rng, unit = np.random.default_rng(2), np.broadcast_to(np.eye(6), (200, 6, 6))
    noise = 2.0 * rng.standard_normal((200, 6))
    gradient = 4.0 * 2.0 * rng.standard_normal((200, 6)) + noise
    equations = structure.DisturbanceEquations(4.0 * unit, gradient, None, unit, {})  # type: ignore[arg-type]
    sizes = np.array([0.5, 1.0, 2.0, 4.0, 8.0])
    assert sizes[_likelihood(equations, unit, sizes).argmax()] == 2.0
    assert _range_of(sizes, (sizes > 0.5) & (sizes < 8.0)) == [1.0, 4.0]
    assert _range_of(sizes, sizes > 1.0) is None


def spoilt(found_drag, steps, found=None):
    """Return what was found, and a torque of so many steps that is not there."""
    found, space = found or found_drag.search, found_drag.source.space
    other = next(s.candidate for s in found.first if s.candidate.name == "torque_trim")
    theta, at = found.estimate.theta.copy(), list(other.indices)
    theta[at] += steps * space.array("step")[at]
    named = (*found.named, NamedEffect(other, 0.001, 20.0))
    last = found.last._replace(at=found.estimate._replace(theta=theta))
    return replace(found, named=named, last=last, judged=last)


def test_a_name_that_held_out_flights_contradict_is_withdrawn_and_no_other(found_drag):
    """One that they cannot show stays."""

    def judged(found):
        after = found_drag.source.gap(found, found.estimate.theta)
        return after, confirmed(found_drag.source, found, after)

    _, (kept, _, _, gone) = judged(spoilt(found_drag, 1e-4))
    assert gone == [] and "torque_trim" in [one.label for one in kept.candidates]
    found = spoilt(found_drag, 0.2)
    after, (kept, gap, without, gone) = judged(found)
    assert gone == ["torque_trim"] and gap.rms < after.rms
    labels = [one.label for one in found_drag.search.candidates]
    assert [one.label for one in kept.candidates] == labels and set(without) == set(labels)
    theta = found.estimate.theta
    np.testing.assert_allclose(kept.estimate.theta[kept.indices], theta[kept.indices], rtol=0.05)


def test_after_a_withdrawal_another_effect_may_explain_more_than_a_name(found_drag, monkeypatch):
    wrong = next(s.candidate for s in found_drag.search.first if s.candidate.label == "rotor_drag")
    found = found_drag.search.refitted([NamedEffect(wrong, 0.001, 20.0)])
    found = spoilt(found_drag, 0.03, found)
    monkeypatch.setattr(type(found_drag.source), "search", lambda *_: found)
    again, warnings = examine(found_drag.source, [], lambda _: None, 0)
    assert warnings == ["torque_trim: withdrawn, held-out flights are no better for it"]
    assert [one.candidate.name for one in again.names] == ["linear_drag"]
    np.testing.assert_allclose(again.theta, found_drag.theta, rtol=0.01, atol=1e-6)


def test_where_the_model_lacks_something_a_name_must_explain_a_share_of_the_rest(found_drag):
    found, after = found_drag.search, found_drag.after
    # As if the rest were so large that the gap without the drag is a fifth larger only.
    raised = found_drag.without["linear_drag"].energy.sum() / 1.2 / after.energy.sum()
    after = after._replace(score=raised * after.score, energy=raised * after.energy)
    misfit = replace(of_rollouts(found.judged), misfit_is_noise=True)
    off = replace(found, judged=found.judged._replace(evidence=misfit))
    withdrawn = [confirmed(found_drag.source, one, after)[3] for one in (found, off)]
    assert withdrawn == [[], ["linear_drag"]]


def test_what_was_withdrawn_has_explained_nothing(found_drag):
    """The verdict is then `unknown`, not `no_gap`."""
    bare = found_drag.search.refitted(())
    assert bare.named == ()
    lasts = (found_drag.search.last, bare.last)
    with_drag, without = (of_rollouts(last).slow_errors(last.block) for last in lasts)
    assert with_drag[0].sum() / with_drag[1].sum() < 1.5
    assert structure_where(without, left(), True) is not None


def test_a_gap_matters_beyond_its_noise_by_more_than_the_thresholds(found_drag):
    def matters(error, floor, count=400, limits=THRESHOLDS):
        held = SimpleNamespace(flight=np.zeros(count), start_s=0.25 * np.arange(count))
        source = replace(found_drag.source, held=held, limits=limits)
        groups = dict.fromkeys(("position", "velocity", "rates"), gaps.Channel(error, floor))
        channels = dict.fromkeys(("0.1 s", "0.5 s", "1 s"), groups)
        return source.is_relevant(found_drag.before._replace(channels=channels))

    assert not matters(0.004, 0.001) and matters(0.04, 0.001) and not matters(0.04, 0.05)
    assert matters(0.04, 0.04, 4), "few rollouts cannot show that it is small"
    assert matters(0.0, 0.0, limits=Thresholds(relevance=(0.0, 0.0, 0.0)))


def test_effects_that_cancel_each_other_are_no_names(found_drag):
    before, after = found_drag.before, found_drag.after
    large, small = gaps.EffectSize(1.0, 0.0, 0.0), gaps.EffectSize(0.01, 0.0, 0.0)

    def relevant(together):
        sizes = {"linear_drag": (large, large), TOGETHER: (together, together)}
        source: Any = SimpleNamespace(
            sizes=lambda _: dict(sizes), names_small=False, limits=THRESHOLDS
        )
        return relevant_part(source, found_drag.search, (before, after))

    found, kept, _, out = relevant(small)
    assert found.named == () and kept is before and out == [("linear_drag", large)]
    found, kept, sizes, out = relevant(large)
    assert found.named and kept is after and sizes == {"linear_drag": large} and out == []


def test_an_effect_that_the_models_error_may_explain_is_no_name_even_if_every_size_counts(
    found_drag,
):
    size, nothing = gaps.EffectSize(1.0, 0.0, 0.0), gaps.EffectSize(0.0, 0.0, 0.0)
    every = Thresholds(relevance=(0.0, 0.0, 0.0))

    def named(upper):
        source: Any = SimpleNamespace(
            sizes=lambda _: {"linear_drag": (size, upper)}, names_small=False, limits=every
        )
        return relevant_part(source, found_drag.search, (found_drag.before, found_drag.after))[
            0
        ].named

    assert named(size) and not named(nothing)


@pytest.mark.extended
def test_an_error_that_is_small_enough_is_not_structure(found_drag):
    bare, both = found_drag.search.refitted(()), (found_drag.before, found_drag.before)

    def remains(relevance):
        limits = replace(THRESHOLDS, relevance=relevance)
        return replace(found_drag.source, limits=limits).remaining(bare, both, 0)

    assert remains(THRESHOLDS.relevance).structured
    rest = remains((100.0, 100.0, 100.0))
    assert not rest.structured and rest.reason == TOO_SMALL


def test_a_bound_does_not_hide_the_models_own_error(found_drag):
    """The error is the change of the fit with coarser inputs, here a little too much drag."""
    found, model = found_drag.search, copy(found_drag.source.model)
    windows = of_rollouts(found.last).windows
    slower = windows.row._replace(vel_w=0.995 * np.asarray(windows.row.vel_w))
    coarser = windows._replace(row=slower)
    source = replace(found_drag.source, model=model, coarser=coarser, coarser_share=1.0)
    sizes = source.sizes(found)
    assert sizes != found_drag.source.sizes(found)
    at = dict(zip(found.indices, found.estimate.theta[found.indices], strict=True))
    entries = [
        replace(entry, low=at.get(k, entry.low), high=at.get(k, entry.high))
        for k, entry in enumerate(model.space.entries)
    ]
    model.space = replace(model.space, entries=tuple(entries))
    assert source.sizes(found) == sizes
