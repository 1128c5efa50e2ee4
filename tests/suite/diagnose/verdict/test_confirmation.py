"""Held-out flights have a say in every name that they could show."""

from dataclasses import replace

import numpy as np

from suite.diagnose.search.evaluation import NamedEffect
from suite.diagnose.sources.examine import confirmed
from suite.diagnose.sources.rollout_source import of_rollouts, structure_where
from suite.diagnose.verdict.residual_structure import ResidualStructure


def spoilt(found_drag, steps):
    """Return what was found, and a torque of so many steps that is not there."""
    found, space = found_drag.search, found_drag.source.space
    other = next(s.candidate for s in found.first if s.candidate.name == "torque_trim")
    theta, at = found.estimate.theta.copy(), list(other.indices)
    theta[at] += steps * space.array("step")[at]
    named = (*found.named, NamedEffect(other, 0.001, 20.0))
    last = found.last._replace(at=found.estimate._replace(theta=theta))
    return replace(found, named=named, last=last, judged=last)


def test_a_name_that_held_out_flights_contradict_is_withdrawn_and_one_that_they_cannot_show_stays(
    found_drag,
):
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
    with_drag, without = (
        of_rollouts(found.last).slow_errors(found.last.block) for found in (found_drag.search, bare)
    )
    assert with_drag[0].sum() / with_drag[1].sum() < 1.5
    assert structure_where(without, ResidualStructure([], {}), True) is not None
