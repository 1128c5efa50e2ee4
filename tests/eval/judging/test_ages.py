"""States and images that are old at the decision."""

import numpy as np
import pytest

from eval.judging.ages import Aged, Delays
from eval.quadrotor.vehicle_file import load_vehicle
from eval.sensors.interface import Ages
from eval.sensors.sensors_file import PERFECT, sensor_set
from eval.worlds.trial import Rules, TrialSpec
from policies.observation import View
from policies.spec import PolicySpec
from tests.support.courses import fly_on, straight
from tests.support.marks import more
from tests.support.pilots import Pursuit, Scripted, Watcher

VEHICLE = load_vehicle("reference")
TRIALS = [TrialSpec("zigzag", 0, seed) for seed in range(3)]
SPEC = PolicySpec(rate_hz=25.0)
DT, PERIOD_S = 0.002, 0.066
STEPS = PERIOD_S / DT


def seen_at(time_s, n=2):
    """A view whose numbers are the time at which it was taken, (n,) or one for all."""
    time_s = np.broadcast_to(np.asarray(time_s, float), (n,))
    at = np.repeat(time_s[:, None], 3, axis=1)
    image = np.repeat(at[:, :, None], 3, axis=2)
    return View(at, np.zeros((n, 3, 3)), at, at, at, at, at, image)


def ages_seen(ages, trials, decisions, period=STEPS):
    """Ages (decisions, 2, N) of state and image at each decision, as a judge would take them."""
    n = len(trials)
    delays = Delays(ages, n, period, DT)
    for slot, trial in enumerate(trials):
        delays.start(slot, trial)
    found = []
    for k in range(decisions):
        now = round(k * period) * DT
        shown = delays.see(seen_at(now, n), np.full(n, k == 0), np.ones(n, bool))
        found.append([now - shown.pos_w[:, 0], now - shown.depth_m[:, 0, 0]])
        clock = np.zeros(n, int)
        for moment in delays.moments(np.full(n, k)):
            steps = round((k + 1) * period) - round(k * period)
            assert (moment.pause >= clock).all() and (moment.pause <= steps).all()
            clock = moment.pause
            # Where no image is wanted there is none.
            view = seen_at(now + clock * DT, n)
            blank = np.where(moment.images[:, None, None], view.depth_m, np.nan)
            for aged, due in moment.taken:
                aged.take(due, view._replace(depth_m=blank))
    return np.array(found)


@pytest.mark.parametrize("age_s", [0.0, 0.01, 0.05, 0.066, 0.1, 0.2])
def test_what_is_seen_has_the_age_that_is_asked_for(age_s):
    for ages, which in (
        (Ages(state_s=age_s), [0]),
        (Ages(image_s=age_s), [1]),
        (Ages(state_s=age_s, image_s=age_s), [0, 1]),
    ):
        found = ages_seen(ages, TRIALS, 20)
        assert (found[0] == 0).all(), "at the start what is seen is the start"
        assert found[6:, which] == pytest.approx(age_s, abs=1e-9)
        others = [k for k in (0, 1) if k not in which]
        assert not found[:, others].any()


@pytest.mark.parametrize(("age_s", "steps"), [(0.0506, 25), (0.0514, 26), (0.0006, 0)])
def test_an_age_between_two_physics_steps_is_that_of_the_nearer_one(age_s, steps):
    found = ages_seen(Ages(state_s=age_s), TRIALS, 12)[6:, 0]
    assert found == pytest.approx(steps * DT, abs=1e-9)


@pytest.mark.parametrize("steps", [0, 1, 8, 16, 20, 34, 51])
def test_decisions_between_two_physics_steps_do_not_change_an_age(steps):
    """At 30 Hz and 500 Hz physics, 17, 16 and 17 steps lie between decisions."""
    found = ages_seen(Ages(state_s=steps * DT), TRIALS[:1], 30, 500.0 / 30.0)[6:, 0]
    assert found == pytest.approx(steps * DT, abs=1e-9)


def test_a_fresh_trial_sees_its_own_start_while_the_others_go_on():
    aged, none = Aged(0.1, 0.5, 2, STEPS, DT), np.zeros(2, bool)
    for k in range(4):
        aged.see(seen_at(k), none | (k == 0), ~none)
        for due in aged.due(np.full(2, k)):
            aged.take(due, seen_at(k + 0.5))
    again = aged.see(seen_at(99.0), np.array([False, True]), ~none)
    assert (again.pos_w[1] == 99.0).all() and (again.pos_w[0] < 4.0).all()


@pytest.mark.parametrize(("age_s", "jitter"), [(0.05, 1.0), more(0.1, 0.4), more(0.02, 1.0)])
def test_ages_that_jitter_have_the_mean_and_the_spread_that_are_asked_for(age_s, jitter):
    ages = Ages(age_s, age_s, jitter)
    found = ages_seen(ages, TRIALS, 300)[6:]
    spread = jitter * age_s
    assert found.min() >= age_s - spread - DT / 2 - 1e-9
    assert found.max() <= age_s + spread + DT / 2 + 1e-9
    assert found.mean() == pytest.approx(age_s, abs=0.1 * spread)
    assert found.std() == pytest.approx(spread / np.sqrt(3), rel=0.1)
    state, image = found[:, 0].ravel(), found[:, 1].ravel()
    assert abs(np.corrcoef(state, image)[0, 1]) < 0.1, "that of the state says nothing of the other"
    turned = ages_seen(ages, TRIALS[::-1], 300)[6:]
    assert np.array_equal(turned[:, :, ::-1], found), "they are set by the trial"


def watched(pilot, sensors, seconds, track):
    watcher, rules = Watcher(pilot), Rules(time_limit_s=seconds)
    how = {"slots": 1, "workers": 1, "rules": rules, "sensors": sensors}
    return fly_on(watcher, track, vehicle=VEHICLE, **how)[0], watcher


def test_in_the_judge_an_age_of_a_period_shows_the_decision_before():
    """Both fly the same as long as the answers are the same: over the first two decisions."""
    trial = 0.2, straight()
    truth, late, dim = (
        watched(Pursuit(spec=SPEC), sensors, *trial)[1].given
        for sensors in (PERFECT, *(sensor_set({"delay": {k: 0.04}}) for k in ("state", "image")))
    )
    (first, image), (second, _) = truth[:2]
    assert np.array_equal(late[0][0], first)
    assert np.array_equal(late[1][0][:, :9], first[:, :9])
    assert not np.array_equal(second[:, :9], first[:, :9])
    assert np.array_equal(dim[1][1], image) and np.array_equal(dim[1][0], second)


@pytest.mark.extended
def test_an_old_state_has_the_misplaced_gate_that_was_next_then():
    trial = 0.8, straight((0.6, 1.2, 9.0))
    (result,), watcher = watched(Pursuit(4.0, spec=SPEC), PERFECT, *trial)
    assert result.gates_passed >= 2, "the flight is to pass gates"
    moved = {"gate_map": {"moved": 0.3}}
    same = Scripted(np.array(watcher.answers_b), spec=SPEC)
    prompt, late = (
        np.stack([state[0, :9] for state, _ in watched(same, sensors, *trial)[1].given])
        for sensors in (sensor_set(moved), sensor_set(moved | {"delay": {"state": 0.12}}))
    )
    assert np.array_equal(late[3:], prompt[:-3])
