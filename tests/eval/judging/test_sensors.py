"""Noise of what a policy sees: of the stated size, a trial's own, and none where it is off."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from eval.judging import sensors as module
from eval.judging.judge import JudgeOptions, fly
from eval.judging.sensors import SensorNoise, Sensors
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds import View
from eval.worlds.trial import Rules, TrialSpec
from tests.support.pilots import RandomNetwork

VEHICLE = load_vehicle("reference")
RULES = Rules(time_limit_s=0.4)
NOISE = SensorNoise(inverse_depth=0.1, gate_m=0.2, pos_m=0.05, vel=0.2, attitude_rad=0.03)
TRIALS = [TrialSpec(track, 4, seed) for track in ("zigzag", "ellipse") for seed in (0, 1, 2)]
RANGE_M, RATE_HZ = 10.0, 20.0


def view(slots, depth=4.0):
    rot_w = Rotation.from_euler("xyz", [[0.3, -0.2, 1.0]] * slots).as_matrix()
    place = np.tile([1.0, 2.0, 3.0], (slots, 1))
    depth_m = np.full((slots, 12, 16), depth)
    return View(
        place, rot_w, 2 * place, 3 * place, 5 * place, rot_w[:, :, 0], rot_w[:, :, 1], depth_m
    )


def watched(noise, trials, times, gate=0, **more):
    """Return what the sensors of the trials' slots show, view after view."""
    eyes = Sensors(noise, len(trials), RATE_HZ, RANGE_M)
    for slot, trial in enumerate(trials):
        eyes.start(slot, trial, 8)
    every = np.ones(len(trials), bool)
    mapped = eyes.misplace(view(len(trials), **more), every * gate, every)
    return [eyes.see(mapped, every) for _ in range(times)]


def many(count):
    return [TrialSpec("zigzag", 3, seed) for seed in range(count)]


def test_no_noise_is_the_truth_itself(monkeypatch):
    truth, every = view(2), np.ones(2, bool)
    eyes = Sensors(SensorNoise(), 2, RATE_HZ, RANGE_M)
    shown = eyes.see(eyes.misplace(truth, np.zeros(2, int), every), every)
    assert all(one is two for one, two in zip(shown, truth, strict=True))
    monkeypatch.setattr(module.Sensors, "see", None)  # a judge without noise has no sensors
    fly(RandomNetwork(), TRIALS[:1], VEHICLE, options=JudgeOptions(rules=Rules(time_limit_s=0.2)))


def test_depth_noise_is_white_in_inverse_depth():
    shown = watched(SensorNoise(inverse_depth=0.02), many(20), 2)
    error = np.stack([1 / seen.depth_m - 1 / 4.0 for seen in shown])
    assert error.std() == pytest.approx(0.02, rel=0.03) and abs(error.mean()) < 1e-3
    flat = error.reshape(40, -1)
    # No pixel, image or trial says anything about another: correlations of chance alone.
    assert np.abs(np.corrcoef(flat) - np.eye(40)).max() < 5 / math.sqrt(flat.shape[1])
    assert np.array_equal(shown[0].pos_w, view(20).pos_w)


@pytest.mark.parametrize("depth", [0.0, 0.2, RANGE_M])
def test_depths_stay_between_nothing_and_the_cameras_range(depth):
    (seen,) = watched(SensorNoise(inverse_depth=0.3), many(3), 1, depth=depth)
    assert np.isfinite(seen.depth_m).all() and (seen.depth_m > 0).all()
    assert seen.depth_m.max() <= RANGE_M * (1 + 1e-12)


def test_a_gates_error_stays_for_the_trial_and_differs_from_gate_to_gate():
    trials = many(600)
    first, second, other = (watched(SensorNoise(gate_m=0.3), trials, n, g)[-1].gate_w
                            for n, g in ((1, 0), (5, 0), (1, 5)))  # fmt: skip
    shift = first - 3 * np.array([1.0, 2.0, 3.0])
    assert shift.std(axis=0) == pytest.approx([0.3] * 3, rel=0.1)
    assert np.abs(shift.mean(axis=0)).max() < 0.06
    assert np.array_equal(first, second)
    assert np.abs(np.corrcoef(shift[:, 0], (other - first + shift)[:, 0])[0, 1]) < 0.2


def test_a_gate_is_misplaced_alike_whether_it_is_the_next_or_the_one_after():
    shown = {gate: watched(SensorNoise(gate_m=0.3), many(2), 1, gate)[0] for gate in (3, 4, 7)}
    truth = view(2)

    def shift(gate, field):
        return getattr(shown[gate], field) - getattr(truth, field)

    assert shift(3, "second_w") == pytest.approx(shift(4, "gate_w"), abs=1e-12)
    assert shift(7, "second_w") == pytest.approx(shift(7, "gate_w"), abs=1e-12)


def test_the_state_wanders_as_a_first_order_process():
    noise = SensorNoise(pos_m=0.1, vel=0.4, attitude_rad=0.02, correlation_s=0.25)
    shown, truth = watched(noise, many(300), 12), view(300)
    pos = np.stack([seen.pos_w - truth.pos_w for seen in shown])
    vel = np.stack([seen.vel_w - truth.vel_w for seen in shown])
    # Stationary from the first observation on.
    assert pos.std(axis=(1, 2)) == pytest.approx([0.1] * 12, rel=0.15)
    assert vel.std(axis=(1, 2)) == pytest.approx([0.4] * 12, rel=0.15)
    for lag in (1, 4):
        kept = np.mean(pos[lag:] * pos[:-lag]) / np.mean(pos**2)
        assert kept == pytest.approx(math.exp(-lag / RATE_HZ / 0.25), abs=0.05)
    turns = np.stack([truth.rot_w.transpose(0, 2, 1) @ seen.rot_w for seen in shown])
    about_b = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec()
    assert about_b.std(axis=0) == pytest.approx([0.02] * 3, rel=0.1)
    assert turns @ turns.swapaxes(-1, -2) == pytest.approx(np.tile(np.eye(3), (12, 300, 1, 1)))


def test_without_correlation_the_state_jumps():
    shown = watched(SensorNoise(vel=0.4, correlation_s=0.0), many(400), 2)
    one, two = ((seen.vel_w - view(400).vel_w).ravel() for seen in shown)
    assert abs(np.corrcoef(one, two)[0, 1]) < 0.15 and not np.array_equal(one, two)


@given(st.floats(0.01, 3.0), st.integers(0, 40), st.integers(0, 3))
def test_two_strengths_have_the_same_draws(factor, seed, slot):
    trials = many(4)
    trials[slot] = TrialSpec("circular", 7, seed)
    alone = watched(SensorNoise(gate_m=1.0, pos_m=1.0), [trials[slot]], 3)[-1]
    among = watched(SensorNoise(gate_m=factor, pos_m=factor, inverse_depth=1.0), trials, 3)[-1]
    truth = view(1)
    for field in ("gate_w", "pos_w"):
        expected = factor * (getattr(alone, field) - getattr(truth, field))[0]
        assert (getattr(among, field)[slot] - getattr(truth, field)[0]) == pytest.approx(expected)


def test_slots_that_do_not_fly_draw_nothing():
    noise = SensorNoise(pos_m=0.1, inverse_depth=0.1)
    eyes = Sensors(noise, 2, RATE_HZ, RANGE_M)
    for slot, trial in enumerate(many(2)):
        eyes.start(slot, trial, 8)
    eyes.see(view(2), np.array([True, False]))
    late = eyes.see(view(2), np.array([False, True]))
    first = watched(noise, many(2), 1)[0]
    assert np.array_equal(late.pos_w[1], first.pos_w[1])
    assert np.array_equal(late.depth_m[1], first.depth_m[1])
    assert np.array_equal(late.pos_w[0], view(2).pos_w[0])


@pytest.mark.parametrize(
    ("field", "value"), [("gate_m", -0.1), ("vel", math.nan), ("correlation_s", math.inf)]
)
def test_noise_that_cannot_be_is_refused_by_name(field, value):
    options = JudgeOptions(noise=replace(SensorNoise(), **{field: value}))
    with pytest.raises(ValueError, match=f"sensor noise {field} is {value!r}; allowed"):
        fly(RandomNetwork(), TRIALS, VEHICLE, options=options)


def results(trials, noise=NOISE, slots=64, world="mujoco"):
    options = JudgeOptions(slots=slots, rules=RULES, noise=noise, workers=1)
    return fly(RandomNetwork(), trials, VEHICLE, world, options)


@pytest.fixture(scope="module")
def noisy():
    return dict(zip(TRIALS, results(TRIALS), strict=True))


def test_every_kind_of_noise_reaches_the_policy(noisy):
    silent = results(TRIALS[:1], SensorNoise())[0]
    assert noisy[TRIALS[0]] != silent
    for field in ("inverse_depth", "gate_m", "pos_m", "vel", "attitude_rad"):
        noise = replace(SensorNoise(), **{field: getattr(NOISE, field)})
        assert results(TRIALS[:1], noise)[0].v_mean != silent.v_mean, field


def test_a_noisy_trials_outcome_is_set_by_the_trial_alone(noisy):
    order = [TRIALS[k] for k in (4, 0, 5, 2)]
    for found in (results(order, slots=3), results(order[::-1])[::-1]):
        assert found == [noisy[trial] for trial in order]
    flown = results(TRIALS[:2], world="reference")
    assert [row._replace(world="mujoco") for row in flown] == [noisy[t] for t in TRIALS[:2]]
