"""Held-out flights have a say in every name that they could show."""

from dataclasses import replace

import numpy as np

from suite.diagnose.search.look import NamedEffect, rollouts_of
from suite.diagnose.verdict.diagnosis import confirmed
from suite.diagnose.verdict.gap import measure, verdict_on


def spoilt(drag, steps):
    """What was found, and a torque that is not there beside the drag that is."""
    found, space = drag.search, drag.model.space
    other = next(s.candidate for s in found.first if s.candidate.name == "torque_trim")
    theta, at = found.estimate.theta.copy(), list(other.indices)
    theta[at] += steps * space.array("step")[at]
    named = (*found.named, NamedEffect(other, 0.001, 20.0))
    last = found.last._replace(at=found.estimate._replace(theta=theta))
    return replace(found, named=named, last=last, judged=last)


def judged(drag, found):
    held, limits = drag.held_windows, drag.limits
    after = measure(drag.model, found.estimate.theta, held, rollouts_of(found.last).noise, limits)
    return after, confirmed(drag.model, found, held, (drag.before, after), limits)


def test_a_name_that_held_out_flights_do_not_want_is_withdrawn(drag):
    found = spoilt(drag, 0.2)
    after, (kept, gap, without, gone) = judged(drag, found)
    assert gone == ["torque_trim"] and gap.rms < after.rms
    assert [one.label for one in kept.candidates] == [one.label for one in drag.search.candidates]
    assert set(without) == {one.label for one in drag.search.candidates}
    theta = found.estimate.theta
    np.testing.assert_allclose(kept.estimate.theta[kept.indices], theta[kept.indices], rtol=0.05)


def test_where_the_model_lacks_something_a_name_must_take_away_a_share_of_the_rest(drag):
    found, held, limits = drag.search, drag.held_windows, drag.limits
    # As if the rest were so large that the gap without the drag is a fifth larger only.
    raised = drag.without["linear_drag"].energy.sum() / 1.2 / drag.after.energy.sum()
    after = drag.after._replace(score=raised * drag.after.score, energy=raised * drag.after.energy)
    misfit = replace(rollouts_of(found.judged), off=True)
    off = replace(found, judged=found.judged._replace(evidence=misfit))
    gone = {
        rollouts_of(one.judged).off: confirmed(drag.model, one, held, (drag.before, after), limits)[
            3
        ]
        for one in (found, off)
    }
    assert gone == {False: [], True: ["linear_drag"]}


def test_one_that_they_could_not_show_stays(drag):
    _, (kept, _, _, gone) = judged(drag, spoilt(drag, 1e-4))
    assert gone == [] and "torque_trim" in [one.label for one in kept.candidates]


def test_what_was_withdrawn_has_explained_nothing(drag):
    """A gap that a withdrawn name had closed is there again: `unknown`, not `no_gap`."""

    def loudness(found):
        slow, expected = rollouts_of(found.last).slow_errors(found.last.block)
        return slow.sum() / expected.sum()

    bare = drag.search.refitted(())
    assert bare.named == () and bare.explained == 0.0
    assert loudness(drag.search) < 1.5 and loudness(bare) > 3.0
    quiet = drag.residual._replace(shapes=[], coloured={})
    gaps = (drag.before, drag.before)
    slow = rollouts_of(bare.last).slow_errors(bare.last.block)
    verdict = verdict_on(False, slow, quiet, gaps, rotor_input=True, limits=drag.limits)
    assert verdict.label == "unknown"
