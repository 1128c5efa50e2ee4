"""The diagnosis's baseline compares like with like: the same error, the same numbers."""

import numpy as np
import pytest

from suite.diagnose.data.noise import noise_of
from suite.diagnose.estimate.gauss_newton import intervals95
from suite.diagnose.evidence.rollouts import RolloutModel, start_estimate
from suite.experiments.bench import diagnose, sysid_baseline
from suite.experiments.bench.rigid_body import REFITTED, make_task


@pytest.fixture(scope="module")
def both():
    """Return (task, model, the baseline's problem) of short flights."""
    task = make_task(20_000, 2.5)
    model = RolloutModel(
        task.nominal, task.space, rotor_input=True, voltage=False, integrator="euler"
    )
    begin = start_estimate(model, task.windows)
    residual = model.residual(begin.theta, begin.free, task.windows)
    return task, model, sysid_baseline.prepare(task, noise_of(residual, task.windows)), residual


def test_both_sides_have_the_same_residuals(both):
    task, _, problem, residual = both
    sigma = noise_of(residual, task.windows)[:12]
    start = task.array("start")
    theirs = np.array(problem.residual(start, problem.params)[0])
    theirs = theirs.reshape(len(task.windows.flight), -1, 12)
    ours = -residual[:, 1:, :12] / sigma
    # The first tenth of a second: then 5 mm of the centre of mass have not turned much over, and
    # attitude errors as rotation vector and as twice a quaternion's part are the same.
    near = np.asarray(task.windows.row_s)[:, 1:] < 0.1
    seen = np.asarray(task.windows.seen)[:, 1:, :12] & near[..., None]
    assert seen.any(axis=(0, 1)).all()
    np.testing.assert_allclose(theirs[seen], ours[seen], rtol=2e-3, atol=2e-2)


@pytest.mark.slow
def test_both_sides_find_what_was_flown(both):
    task, model, problem, _ = both
    answers = [diagnose.refit(model, task), sysid_baseline.refit(problem)]
    widths = [intervals95(equations).half_width for _, equations in answers]
    for (values, _), width in zip(answers, widths, strict=True):
        assert np.all(np.abs(values - task.truth) < 2.0 * width)
        assert np.all(width < task.array("step"))
    assert np.all(np.abs(answers[0][0] - answers[1][0]) < 1.5 * np.hypot(*widths))


def test_a_rotation_is_told_with_its_sign():
    still = np.array([[0.0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0]])
    half = 0.01
    turned = still.copy()
    turned[0, 3:7] = [np.cos(half), 0.0, 0.0, np.sin(half)]
    expected = np.zeros((1, 12))
    expected[0, 5] = 2 * np.sin(half)
    np.testing.assert_allclose(sysid_baseline._difference(turned, still), expected, atol=1e-12)
    np.testing.assert_allclose(sysid_baseline._difference(-turned, still), expected, atol=1e-12)


def test_a_task_says_what_is_fitted_and_repeats_by_its_seed():
    task, again = make_task(3, 2.5), make_task(3, 2.5)
    assert {name.split(".")[0] for name in task.names} == set(REFITTED)
    assert len(task.names) == len(set(task.names)) == len(task.truth)
    assert not task.nominal.effects and np.any(task.truth != task.array("start"))
    np.testing.assert_array_equal(task.truth, again.truth)
    np.testing.assert_array_equal(task.windows.row_pos_w, again.windows.row_pos_w)
