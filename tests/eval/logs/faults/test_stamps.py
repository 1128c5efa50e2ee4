"""Stamps of the arrival of messages: found and spaced evenly; uneven sampling is not."""

import numpy as np
import pytest

from eval.importers.cleaning import check_evenness
from eval.importers.signals import Recording, Signal
from eval.logs.faults.check import CLOCK, CheckContext, run_checks
from eval.logs.faults.clocks.stamps import even_stamps

STEP_S = 0.01


def path(time_s):
    """Return positions (T, 3) of a flight of about 4 m/s."""
    return np.stack([3.0 * np.sin(1.3 * time_s), 2.0 * np.cos(2.0 * time_s), 0.2 * time_s], axis=1)


def flight(seed=0, late=0.6, noise_m=0.002, count=1500):
    """Return even times, stamps up to `late` of a row later, and noisy positions."""
    rng = np.random.default_rng(seed)
    even_s = 5.0 + STEP_S * np.arange(count)
    stamps = even_s + late * STEP_S * rng.uniform(size=count)
    return even_s, stamps, path(even_s) + noise_m * rng.normal(size=(count, 3))


@pytest.mark.parametrize("lost", [(), (200, 201, 900)])
def test_jitter_is_found_and_removed_but_for_its_mean(lost):
    even_s, stamps, pos = (np.delete(x, lost, axis=0) for x in flight())
    found = even_stamps(stamps, [pos])
    assert found is not None
    late_s = found - even_s
    # What remains is the scatter of means over a hundred stamps, a second.
    assert late_s.std() < 0.15 * (stamps - even_s).std()
    assert late_s.mean() == pytest.approx((stamps - even_s).mean(), abs=1e-4)


@pytest.mark.parametrize("burst", [2, 3, 4, 8])
def test_bursts_of_messages_are_found_and_removed_but_for_their_mean(burst):
    even_s, _, pos = flight()
    place = np.arange(len(even_s))
    last = np.minimum((place // burst + 1) * burst - 1, len(place) - 1)
    stamps = even_s[last] + 1e-4 * (place % burst)
    found = even_stamps(stamps, [pos])
    assert found is not None
    assert (found - even_s).std() < 0.03 * (stamps - even_s).std()
    assert even_stamps(stamps, [path(stamps)]) is None, "sampled in bursts"


def test_uneven_sampling_slow_flight_noise_and_exact_clocks_are_no_jitter():
    even_s, stamps, pos = flight()
    assert even_stamps(stamps, [path(stamps)]) is None, "sampled at its stamps"
    assert even_stamps(even_s + 0.05 * (stamps - even_s), [pos]) is None, "0.1 ms"
    still = 0.002 * np.random.default_rng(1).normal(size=pos.shape)
    for late in (0.3, 0.6, 0.9):
        assert even_stamps(flight(late=late)[1], [still]) is None, "a hover"
    assert even_stamps(stamps[:50], [pos[:50]]) is None
    assert even_stamps(stamps, []) is None
    # A clock that wanders slowly against the sampling is kept.
    wander_s = 0.005 * np.sin(0.3 * even_s)
    found = even_stamps(stamps + wander_s, [pos])
    assert found is not None and np.std(found - even_s - wander_s) < 3e-4


def test_ticks_of_a_clock_of_which_many_are_lost_are_no_jitter():
    """Slower signals, interpolated to such rows, may seem to be smoother in even times."""
    even_s, stamps, pos = flight()
    kept = np.random.default_rng(2).uniform(size=len(even_s)) > 0.4
    smoother = [path(STEP_S * np.arange(kept.sum()))]
    assert even_stamps(even_s[kept], smoother) is None
    assert even_stamps(stamps[kept], smoother) is None
    assert (
        even_stamps(np.delete(stamps, [200, 900]), [np.delete(pos, [200, 900], axis=0)]) is not None
    )


def test_stretches_of_half_the_rate_are_no_jitter():
    """Poses that repeat are left out, and the stamps of the others are ticks of 4 ms."""
    even_s, _, _ = flight()
    is_kept = (np.arange(len(even_s)) % 60 < 30) | (np.arange(len(even_s)) % 2 == 0)
    stamps = 0.004 * np.ceil(even_s[is_kept] / 0.004)
    assert even_stamps(stamps, [path(even_s[is_kept])]) is None


def test_a_check_names_it_and_later_checks_get_even_times():
    even_s, stamps, pos = flight()
    times = []

    def later(rows, _):
        times.append(rows["time"])
        return []

    (found,), _, rows = run_checks(
        {"time": stamps, "pos": pos}, (*CLOCK, later), CheckContext(), False
    )
    assert found.fault == "clock_jitter" and found.size == pytest.approx(
        0.6 * STEP_S / 12**0.5, rel=0.05
    )
    assert "1.7 ms" in found.evidence and "suite import" in found.fix
    assert np.std(times[0] - even_s) < 3e-4
    np.testing.assert_array_equal(rows["time"], stamps)


def test_an_import_spaces_the_stamps_of_all_signals_of_a_message_evenly():
    even_s, stamps, pos = flight()
    gyro_s = np.arange(5.0, 20.0, 0.004)
    rate = np.cos(gyro_s)[:, None] * np.ones(3)
    signals = {"pos": Signal(stamps, pos), "cmd_thrust": Signal(stamps, pos[:, :1])}
    recording = Recording("bag", {**signals, "rate": Signal(gyro_s, rate)})
    new = check_evenness(recording, True)
    (found,) = new.findings
    assert found.status == "corrected" and "stamps of pos, cmd_thrust" in found.evidence
    assert np.std(new.signals["pos"].time_s - even_s) < 3e-4
    np.testing.assert_array_equal(new.signals["pos"].time_s, new.signals["cmd_thrust"].time_s)
    np.testing.assert_array_equal(new.signals["rate"].time_s, gyro_s)
    same = check_evenness(recording, False)
    (found,) = same.findings
    assert same.signals is recording.signals and found.status == "doubt" and "--no-fix" in found.fix
