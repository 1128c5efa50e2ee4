"""Planned laps: what is stored is flown on today's tracks, and laps are compared with them."""

import numpy as np
import pytest

from eval.judging.plans import over_plan, plans
from eval.worlds.trial import TrialSpec, track_of
from tests.support.judged_cells import result
from tracks.geometry.crossing import crossing


def test_every_plan_passes_the_gates_of_its_track_in_order():
    assert len(plans()) == 24
    for trial, plan in plans().items():
        track = track_of({}, trial)
        assert np.abs(plan.pos_w[0] - track.start_pos_w).max() < 1e-3
        assert plan.time_s[-1] == pytest.approx(plan.lap_s, abs=1e-3)
        when = []
        for center_w, rot_w, opening_g in zip(*track.scene.gates[:3], strict=True):
            passed, _ = crossing(center_w, rot_w, opening_g, plan.pos_w[:-1], plan.pos_w[1:])
            assert passed.any(), trial
            when.append(np.flatnonzero(passed)[0])
        assert when == sorted(when) and when[-1] == len(plan.pos_w) - 2, trial


def test_the_ratio_is_of_finished_trials_on_planned_tracks():
    rows = [result(0), result(1, False), result(2), result(0, policy="other", difficulty=4)]
    (found,) = over_plan(rows)
    lap_s = plans()[TrialSpec("zigzag", 3, 0)].lap_s
    assert (found.policy, found.finished, found.planned) == ("ours", 1, 2)
    assert found.ratio.value == pytest.approx(rows[0].time_s / lap_s)
    assert np.isnan(over_plan([result(1, False)])[0].ratio.value)
