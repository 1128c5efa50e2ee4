"""The gap: intervals of few stretches, stretches that overlap, and signals slower than the rows."""

from types import SimpleNamespace

import numpy as np
import pytest

from suite.diagnose.data.colour import Noise
from suite.diagnose.data.whitening import Linearisation
from suite.diagnose.data.windows import CHANNELS, STATE
from suite.diagnose.thresholds import THRESHOLDS
from suite.diagnose.verdict.gap import Gap, gap_of, overlap


def test_the_interval_of_few_stretches_is_no_point_and_one_of_three_decides_nothing():
    few = Gap(np.array([1.0, 1.0, 9.0]), np.zeros(3), {})
    low, high = few.ci95(0)
    assert low < few.rms < high
    before, after = (Gap(np.ones(3), np.array(e), {}) for e in ([0.0] * 3, [-10.0, -10.0, 400.0]))
    assert not after.exceeds(before, 0.25, THRESHOLDS)
    rng, covered = np.random.default_rng(1), 0
    for seed in range(200):
        score = rng.chisquare(20, 5) / 20
        low, high = Gap(score, score, {}).ci95(seed)
        covered += low <= 1.0 <= high
    # Five independent stretches: a bootstrap is too narrow, but not useless.
    assert covered > 0.7 * 200


def test_errors_that_last_are_drawn_together():
    # 30 independent errors, each of 20 neighbouring moments.
    covered = dict.fromkeys((4, 20), 0)
    for seed in range(100):
        score = np.repeat(np.random.default_rng(seed).chisquare(4, 30) / 4, 20)
        for together in covered:
            low, high = Gap(score, score, {}, together=together).ci95(seed)
            covered[together] += low <= 1.0 <= high
    assert covered[4] < 75 and covered[20] > 85


def test_a_stretch_counts_by_how_much_it_overlaps_the_next():
    def weight(start_s, flight):
        return overlap(SimpleNamespace(start_s=np.asarray(start_s), flight=np.asarray(flight)))

    assert weight(0.25 * np.arange(9), np.zeros(9)) == pytest.approx(0.25)
    assert weight(0.6 * np.arange(9), np.zeros(9)) == pytest.approx(0.6)
    assert weight([0.0, 0.25, 0.0, 3.0], [0, 0, 1, 1]) == pytest.approx(0.625)
    assert weight([0.0, 0.0], [0, 1]) == 1.0


def test_an_error_is_read_where_its_signal_was_measured():
    count, rows = 6, 101
    time_s, valid = np.linspace(0.0, 1.0, rows), np.zeros((count, rows, CHANNELS), bool)
    # The pose in odd rows only: neither in the last row nor at the other horizons.
    valid[:, 1::2, :6] = valid[..., 6:STATE] = True
    residual = np.zeros(valid.shape)
    residual[..., 0], residual[..., 6] = time_s**2, 2.0 * time_s
    windows = SimpleNamespace(
        row_s=np.tile(time_s, (count, 1)), valid=valid, flight=np.zeros(count, int),
        start_s=0.25 * np.arange(count), start_rotor_error=np.full(count, 1e-3),
        rotor_valid=np.zeros((count, rows, 4), bool),
    )  # fmt: skip
    sigma = np.where(np.arange(CHANNELS) < STATE, 0.01, np.nan)
    slope = np.zeros((*valid.shape, 16))
    slope[..., np.arange(12), np.arange(12)] = 1.0
    linear = Linearisation(
        np.where(valid, residual, 0.0),
        np.where(valid[..., None], slope, 0.0),
        np.zeros((count, 16)),
    )
    last = gap_of(linear, windows, Noise(sigma, {})).channels["1 s"]
    assert last["position"].error == pytest.approx(0.99**2, rel=1e-6)
    assert last["velocity"].error == pytest.approx(2.0, rel=1e-6)
