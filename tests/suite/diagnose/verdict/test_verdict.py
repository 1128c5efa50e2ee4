"""What the numbers allow to be said: gaps, structure in what is left, wind, and the verdict."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.data.windows import KNOTS, STATE
from suite.diagnose.search.look import rollouts_of
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict import black_box, checks, diagnosis
from suite.diagnose.verdict.disturbances import _likelihood, find_turbulence
from suite.diagnose.verdict.gap import (
    Gap,
    Verdict,
    measure,
    noise_floor,
    share_left,
    start_noise,
    verdict_on,
    worse,
)
from suite.diagnose.verdict.residual_structure import (
    AXES,
    DisturbanceEquations,
    ResidualStructure,
    ShapeScore,
    disturbance_equations,
    residual_structure,
    shape_library,
)


def gap(energy):
    return Gap(np.asarray(energy) / 10.0, np.asarray(energy), {})


def slow_errors(size=1.0):
    """Slow errors of 10 windows, and what is expected."""
    energy = np.full((10, STATE), 5.0)
    energy[:, 6] *= size
    return energy, np.full((10, STATE), 5.0)


QUIET = slow_errors()


def scores(before, after):
    """Gaps whose energy above the noise floor is `before` and `after`."""
    one, two = (Gap(np.full(8, 1.0 + above), np.zeros(8), {}) for above in (before, after))
    return one, two


SAME = scores(0.0, 0.0)


def left(p_value=0.5, coloured=0.5, gain=1.0):
    shapes = [ShapeScore("force with the speed", gain, p_value)]
    return ResidualStructure(shapes, dict.fromkeys(AXES, coloured))


def test_noise_alone_is_no_gap_and_a_name_without_structure_is_named():
    assert verdict_on(False, QUIET, left(), SAME, False) == Verdict("no_gap")
    assert verdict_on(True, QUIET, left(), SAME, False) == Verdict("named")


def test_structure_is_told_by_what_it_goes_with():
    shaped = verdict_on(False, QUIET, left(p_value=1e-4), SAME, False)
    assert shaped == Verdict("unknown", 1.0, "force with the speed")
    coloured = verdict_on(False, QUIET, left(coloured=1e-6), SAME, False)
    assert coloured.where == "a changing " + ", ".join(AXES)
    loud = verdict_on(False, slow_errors(10.0), left(), SAME, False)
    assert loud.label == "unknown" and loud.where == "errors of velocity x"


def test_what_explains_most_is_named_in_part():
    seen = left(p_value=1e-4)
    verdict = verdict_on(True, QUIET, seen, scores(11.0, 1.0), False)
    assert verdict.label == "partly" and verdict.share_left == pytest.approx(
        (2**0.5 - 1.0) / (12**0.5 - 1.0)
    )
    assert verdict_on(True, QUIET, seen, scores(11.0, 9.0), False).label == "unknown"


def test_the_share_that_is_left_is_that_of_the_gaps():
    before, after = scores(24.0, 6.0)
    assert (before.rms, after.rms) == (5.0, pytest.approx(np.sqrt(7.0)))
    assert share_left(before, after) == pytest.approx((7**0.5 - 1.0) / 4.0)
    assert share_left(after, before) == 1.0 and share_left(*scores(3.0, -0.1)) == 0.0


def test_rotor_speeds_as_input_may_be_noisier():
    quiet = slow_errors(3.0)
    assert verdict_on(False, quiet, left(coloured=1e-6), SAME, True) == Verdict("no_gap")
    assert verdict_on(False, quiet, left(), SAME, False).label == "unknown"
    strict = replace(THRESHOLDS, structure_rotor_input=1.1)
    assert verdict_on(False, quiet, left(), SAME, True, strict).label == "unknown"


def test_a_gaps_interval_holds_it_and_a_rise_is_seen():
    rng = np.random.default_rng(0)
    before, after = gap(rng.chisquare(10, 80)), gap(rng.chisquare(10, 80) + 8.0)
    low, high = before.ci95(0)
    assert low < before.rms < high and high - low < 0.3
    assert before.ci95(0) == before.ci95(0) != before.ci95(1)
    assert worse(before, after) and not worse(after, before) and not worse(before, before)
    assert not worse(before, after, limits=Thresholds(doubt_chi2=1e6))


def test_the_noise_floor_is_what_start_and_row_make():
    slope = np.zeros((1, STATE, STATE))
    slope[0, 0, 6] = 0.5
    noise = np.zeros(STATE)
    noise[[0, 6]] = 0.3, 0.8
    floor = noise_floor(slope, noise)
    assert floor[0, 0] == pytest.approx(0.5) and floor[0, 6] == pytest.approx(0.8)


def test_a_diagnosis_is_measured_on_what_was_held_out(drag):
    assert isinstance(drag, diagnosis.Diagnosis) and drag.verdict.label == "named"
    assert drag.input_source == "commands" and drag.fitted is not None
    sigma, held = drag.sigma, drag.held_windows
    again = measure(drag.model, drag.fitted, held, rollouts_of(drag.search.last).noise)
    np.testing.assert_array_equal(again.score, drag.after.score)
    assert drag.after.rms < 1.3 < drag.before.rms
    noise = start_noise(sigma, held, drag.model.free)
    np.testing.assert_array_equal(noise[:STATE], np.where(np.isfinite(sigma), sigma, 0.0)[:STATE])
    # Rotors begin as the commands at the measured rates leave them, which gyro noise moves.
    assert (noise[STATE:] == noise[STATE]).all() and 0.05 < noise[STATE] < 50.0


def test_without_the_name_its_shape_is_left(drag):
    found = drag.search
    evidence, bare = rollouts_of(found.last), found.estimate._replace(theta=drag.start)
    windows = evidence.trusted
    equations = disturbance_equations(drag.model, windows, evidence.whitening, bare)
    fold = np.arange(len(windows.flight)) % 5
    with_gap = residual_structure(equations, fold)
    assert with_gap.shapes[0].gain > 10.0 * max(drag.residual.shapes[0].gain, 1.0)
    assert min(with_gap.coloured.values()) < 1e-6 <= min(drag.residual.coloured.values())


def test_shapes_are_columns_that_their_groups_share_out(drag):
    found = drag.search
    windows = rollouts_of(found.last).trusted
    response = drag.model.respond(found.estimate.theta, found.estimate.free, windows)
    library = shape_library(response.knot, np.asarray(windows.start_s))
    columns = [column for group in library.groups for column in group.columns]
    assert columns == list(range(library.unit.shape[-1]))
    assert library.unit.shape[1] == KNOTS * 6 and np.isfinite(library.unit).all()
    fewer = shape_library(response.knot, np.asarray(windows.start_s), Thresholds(cells=2))
    assert fewer.unit.shape[-1] < library.unit.shape[-1]


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


def test_a_drag_is_not_taken_for_wind(drag):
    found = drag.search
    evidence = rollouts_of(found.last)
    with_it = (evidence.trusted, evidence.whitening, found.estimate)
    equations = disturbance_equations(drag.model, *with_it)
    assert find_turbulence(drag.model, found.estimate.theta, equations) is None


def test_what_was_held_out_is_not_fitted_by_the_black_box(drag):
    known = black_box._not_held_out(drag.cut(0.5), drag.held_windows)
    assert len(known.flight) and not set(known.flight) & set(drag.held_windows.flight)
    top, mean = black_box._speeds(drag.logs, known)
    assert (top >= mean).all() and (mean > 0.0).all()


def test_checks_know_the_logs_and_their_motors(drag, drag_checks):
    assert isinstance(drag_checks, checks.Checks) and drag_checks.black_box is None
    assert [fact.name for fact in drag_checks.facts] == [log.name for log in drag.logs]
    assert drag_checks.actuators[0].followed > 0.9
