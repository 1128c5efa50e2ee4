"""Where model and flights disagree, on errors whose pattern is known beforehand."""

import numpy as np

from suite.diagnose.checks.disagreement import (
    CHANNELS,
    UNITS,
    Disagreement,
    binned,
    conditions_of,
    in_words,
)
from suite.diagnose.data.windows import cut
from tests.support.diagnosis_flights import fly
from tests.support.vehicles import PLAIN

COUNT = 180


def made(growth, stride_s=0.5, seed=0):
    """Rollouts of white noise; `growth(conditions)` (W,) multiplies velocity x after 0.5 s."""
    rng = np.random.default_rng(seed)
    conditions = {name: rng.uniform(0.0, 10.0, COUNT) for name in UNITS}
    over = rng.standard_normal((3, COUNT, 12))
    over[1, :, CHANNELS.index("velocity x")] *= growth(conditions)
    edges = {name: np.linspace(0.0, 10.0, 6) for name in UNITS}
    blank = np.zeros((COUNT, 6))
    return Disagreement(conditions, edges, stride_s, over, over, blank, blank, blank, blank)


def test_the_bin_with_the_strongest_structure_is_told():
    where = made(lambda c: 1.0 + np.maximum(c["speed"] - 6.0, 0.0))
    told = in_words(where, where.before)
    assert told is not None
    assert told.startswith("velocity x (body axes) after 0.5 s at a speed of 8 to 10 m/s")
    table, count = binned(where, where.before, "speed")
    assert count.sum() == COUNT and table.shape == (3, 5, 12)
    line = table[1, :, CHANNELS.index("velocity x")]
    assert line[4] > 3.0 and abs(line[:3] - 1.0).max() < 0.4


def test_structure_that_goes_with_nothing_is_told_as_such():
    where = made(lambda c: 3.0)
    told = in_words(where, where.before)
    assert told is not None and "3." in told and "in all that was flown" in told


def test_noise_is_not_taken_for_structure():
    told = [in_words(where := made(lambda c: 1.0, seed=k), where.before) for k in range(30)]
    assert told == [None] * 30


def test_overlapping_rollouts_count_less():
    weak = [made(lambda c: 1.3, stride, seed=3) for stride in (0.5, 0.02)]
    first, second = (in_words(where, where.before) for where in weak)
    assert first is not None and second is None


def test_what_was_not_measured_does_not_count():
    where = made(lambda c: 4.0)
    over = where.before.copy()
    over[..., 6:9] = np.nan
    assert in_words(where, over) is None
    table, _ = binned(where, over, "speed")
    assert np.isnan(table[..., 6:9]).all() and np.isfinite(table[..., :6]).all()


def test_conditions_are_those_of_the_flight():
    log = fly(PLAIN, 1, duration_s=4.0)
    windows, _ = cut([log], PLAIN, False, 0.5)
    assert windows is not None
    found = conditions_of(windows, PLAIN)
    rows = np.searchsorted(log.time_s, np.asarray(windows.start_s) - 1e-9)
    np.testing.assert_allclose(found["speed"], np.linalg.norm(log.vel_w[rows], axis=1))
    np.testing.assert_allclose(found["height"], log.pos_w[rows, 2])
    assert log.thrust_cmd is not None
    mean = [log.thrust_cmd[row : row + 50].mean() for row in rows]
    np.testing.assert_allclose(found["thrust"], mean, rtol=1e-6)
