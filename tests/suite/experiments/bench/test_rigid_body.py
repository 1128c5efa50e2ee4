"""What both sides of the diagnosis benchmark are given."""

import numpy as np

from eval.effects import EFFECTS
from suite.blind.oracle.strength import given_vehicle
from suite.experiments.bench.rigid_body import REFITTED, _drawn, make_task


def test_the_truth_is_off_by_usual_sizes_and_leaves_what_cannot_be_seen():
    nominal = given_vehicle("bare")
    drawn = _drawn(nominal, np.random.default_rng(1))
    assert tuple(drawn) == REFITTED
    (offset,) = EFFECTS["mass_offset"].parameters
    low, high = offset.typical
    assert low <= abs(drawn["mass_offset"].offset) <= high
    (place,) = EFFECTS["com_offset"].parameters
    com = np.asarray(drawn["com_offset"].offset)
    assert place.unseen and not com[list(place.unseen)].any() and com.any()


def test_a_task_says_what_is_fitted_and_repeats_by_its_seed():
    task, again = make_task(3, 2.5), make_task(3, 2.5)
    assert {name.split(".")[0] for name in task.names} == set(REFITTED)
    assert len(task.names) == len(set(task.names)) == len(task.truth)
    assert not task.nominal.effects and np.any(task.truth != task.array("start"))
    np.testing.assert_array_equal(task.truth, again.truth)
    np.testing.assert_array_equal(task.windows.row_pos_w, again.windows.row_pos_w)
