"""States and images that are old at the decision, and images that never come."""

import numpy as np
import pytest

from eval.judging.ages import Aged, Delays
from eval.judging.judge import JudgeOptions, fly
from eval.judging.sensors import SensorNoise
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules, TrialSpec
from policies.observation import View
from policies.spec import PolicySpec
from tests.support.pilots import Pursuit

VEHICLE = load_vehicle("reference")
TRIALS = [TrialSpec("zigzag", 0, seed) for seed in range(3)]
RULES = Rules(time_limit_s=1.5)


def seen_at(time_s, n=2):
    """A view whose numbers are the time at which it was taken."""
    at = np.full((n, 3), float(time_s))
    return View(at, np.zeros((n, 3, 3)), at, at, at, at, np.full((n, 2, 2), float(time_s)))


@pytest.mark.parametrize("age_s", [0.0, 0.01, 0.05, 0.066, 0.1, 0.2])
def test_what_is_seen_has_the_age_that_is_asked_for(age_s):
    dt, period = 0.002, 0.066 / 0.002
    aged, fresh = Aged(age_s, period, dt), np.ones(2, bool)
    for k in range(20):
        now = 0.066 * k
        shown = aged.see(seen_at(now), fresh)
        fresh = np.zeros(2, bool)
        if k >= 6:
            assert shown.pos_w == pytest.approx(now - age_s, abs=1e-9)
        if aged.periods:
            aged.take(seen_at(now + aged.pause * dt))
    again = aged.see(seen_at(99.0), np.array([False, True]))
    assert (
        (again.pos_w[1] == 99.0).all() and (again.pos_w[0] < 99.0 - age_s + 1e-9).all() or not age_s
    )


def test_a_lost_image_is_the_one_before_and_the_state_comes_all_the_same():
    delays, fly_all = Delays(SensorNoise(image_loss=0.4), 2, 33.0, 0.002), np.ones(2, bool)
    for slot, trial in enumerate(TRIALS[:2]):
        delays.start(slot, trial)
    assert delays.pauses == []
    repeats, before = 0, None
    for k in range(500):
        shown = delays.see(seen_at(k), np.full(2, k == 0), fly_all)
        assert (shown.pos_w == k).all()
        image = shown.depth_m[:, 0, 0]
        if before is not None:
            assert ((image == k) | (image == before)).all()
            repeats += int((image == before).sum())
        before = image
    assert repeats / 1000 == pytest.approx(0.4, abs=0.05)


def test_which_images_are_lost_is_set_by_the_trial():
    def lost(trials):
        delays = Delays(SensorNoise(image_loss=0.5), len(trials), 33.0, 0.002)
        for slot, trial in enumerate(trials):
            delays.start(slot, trial)
        n, seen = len(trials), []
        for k in range(60):
            now, first = seen_at(k, n), np.full(n, k == 0)
            seen.append(delays.see(now, first, np.ones(n, bool)).depth_m[:, 0, 0] < k)
        return np.array(seen).T

    one, other = lost(TRIALS[:2])
    assert not np.array_equal(one, other)
    assert np.array_equal(lost([TRIALS[1], TRIALS[0]]), [other, one])


class Watcher(Pursuit):
    """Keeps what it was given."""

    given: list

    def act(self, hidden, state, image, fresh):
        self.given.append((state.copy(), image.copy()))
        return super().act(hidden, state, image, fresh)


def given(noise, trials=TRIALS[:1], slots=1):
    pilot = Watcher(spec=PolicySpec(rate_hz=25.0))
    pilot.given = []
    options = JudgeOptions(slots=slots, workers=1, rules=RULES, noise=noise)
    results = fly(pilot, trials, VEHICLE, options=options)
    return results, pilot.given


def test_in_the_judge_an_age_of_a_period_shows_the_decision_before():
    """Both fly the same as long as the answers are the same: over the first two decisions."""
    _, truth = given(SensorNoise())
    _, late = given(SensorNoise(state_age_s=0.04))
    assert np.array_equal(late[0][0], truth[0][0]) and np.array_equal(
        late[1][0][:, :9], truth[0][0][:, :9]
    )
    assert not np.array_equal(truth[1][0][:, :9], truth[0][0][:, :9])
    _, dim = given(SensorNoise(image_age_s=0.04))
    assert np.array_equal(dim[1][1], truth[0][1]) and np.array_equal(dim[1][0], truth[1][0])


def test_a_late_trials_outcome_is_set_by_the_trial_alone():
    noise = SensorNoise(state_age_s=0.055, image_age_s=0.03, image_loss=0.2)
    together, _ = given(noise, TRIALS, slots=2)
    assert together != given(SensorNoise(), TRIALS, slots=2)[0]
    assert together == [given(noise, [trial])[0][0] for trial in TRIALS]


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="image_loss is 1.5; allowed are shares"):
        given(SensorNoise(image_loss=1.5))
    with pytest.raises(ValueError, match="shows nothing late"):
        options = JudgeOptions(noise=SensorNoise(state_age_s=0.1))
        fly(Pursuit(), TRIALS[:1], VEHICLE, "reference", options)
