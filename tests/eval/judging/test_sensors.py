"""Sensor models and the estimator in the judge: errors and outcomes are the trial's own."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from eval.judging import judge, sensors
from eval.judging import judge as module
from eval.judging.judge import JudgeOptions
from eval.judging.sensors import Filtered, Sensors, inertial
from eval.quadrotor.vehicle_file import load_vehicle
from eval.sensors.filter.kalman import update_gate
from eval.sensors.interface import rotation_since
from eval.sensors.sensors_file import PERFECT, load_sensors, scale_sensors, sensor_set
from eval.worlds.trial import Rules, TrialSpec
from policies.observation import View
from policies.spec import PolicySpec
from tests.support.marks import more
from tests.support.pilots import Pursuit, random_network
from tests.support.reference import assert_alike, fly
from tracks.geometry.camera import Camera
from tracks.geometry.rotation import exp_rot

VEHICLE = load_vehicle("reference")
RULES = Rules(time_limit_s=0.2)
SET = sensor_set({"gate_map": {"moved": 1.0}, "state_noise": {"position": 1.0}})
TRIALS = [TrialSpec(track, 4, seed) for track in ("zigzag", "ellipse") for seed in (0, 1, 2)]
RATE_HZ, CAMERA = 20.0, Camera(width=16, height=12)


def view(slots, depth=4.0):
    rot_w = Rotation.from_euler("xyz", [[0.3, -0.2, 1.0]] * slots).as_matrix()
    place = np.tile([1.0, 2.0, 3.0], (slots, 1))
    depth_m, number = np.full((slots, 12, 16), depth), np.zeros(slots, int)
    axes_w = rot_w[:, :, 0], rot_w[:, :, 1]
    return View(place, rot_w, 2 * place, 3 * place, 5 * place, *axes_w, depth_m, number)


def watched(sensors, trials, times):
    """Return what the sensors of the trials' slots show, view after view."""
    eyes = Sensors(sensors, len(trials), RATE_HZ, CAMERA)
    for slot, trial in enumerate(trials):
        eyes.start(slot, trial)
    every = np.ones(len(trials), bool)
    return [eyes.see(view(len(trials)), every & (k == 0), every) for k in range(times)]


def many(count):
    return [TrialSpec("zigzag", 3, seed) for seed in range(count)]


def test_perfect_sensors_are_none(monkeypatch):
    monkeypatch.setattr(module, "Sensors", None)
    assert load_sensors("perfect") == PERFECT
    options = JudgeOptions(rules=Rules(time_limit_s=0.2), sensors=scale_sensors(SET, 0.0))
    fly(random_network(), TRIALS[:1], VEHICLE, options=options)


@given(st.floats(0.01, 3.0), st.integers(0, 40), st.integers(0, 3))
def test_two_magnitudes_have_the_same_draws(factor, seed, slot):
    trials = many(4)
    trials[slot] = TrialSpec("circular", 7, seed)
    alone = watched(SET, [trials[slot]], 3)[-1]
    among = watched(scale_sensors(SET, factor), trials, 3)[-1]
    truth = view(1)
    for field in ("gate_w", "pos_w"):
        expected = factor * (getattr(alone, field) - getattr(truth, field))[0]
        assert (getattr(among, field)[slot] - getattr(truth, field)[0]) == pytest.approx(expected)


def test_slots_that_do_not_fly_draw_nothing_and_a_fresh_one_begins_anew():
    eyes, on = Sensors(load_sensors("all"), 2, RATE_HZ, CAMERA), np.array([True, False])
    for slot, trial in enumerate(many(2)):
        eyes.start(slot, trial)
    eyes.see(view(2), on, on)
    late = eyes.see(view(2), ~on, ~on)
    eyes.start(0, many(3)[2])
    again = eyes.see(view(2), on, on)
    first, third = (watched(load_sensors("all"), [many(3)[k]], 1)[0] for k in (1, 2))
    for field, one in first._asdict().items():
        assert np.array_equal(getattr(late, field)[1], one[0]), field
        assert np.array_equal(getattr(again, field)[0], getattr(third, field)[0]), field
    assert np.array_equal(late.pos_w[0], view(2).pos_w[0])


def results(trials, sensors, slots=64, world="mujoco"):
    options = JudgeOptions(slots=slots, rules=RULES, sensors=sensors, workers=1)
    return fly(random_network(), trials, VEHICLE, world, options)


@pytest.fixture(scope="module")
def flown():
    return dict(zip(TRIALS, results(TRIALS, load_sensors("all")), strict=True))


def test_every_model_reaches_the_policy():
    few, flying = TRIALS[:3], {}
    true = results(few, PERFECT)
    for name in ("all", "tof-depth", "nanobench"):
        flying |= load_sensors(name).models
    for model in set(flying) - {"imu"}:
        # Grown, as rare faults would not come within so short a flight.
        strong = scale_sensors(sensor_set({model: flying[model]._asdict()}), 1e3)
        found = (results([trial], strong)[0].v_mean for trial in few)
        assert any(one != two.v_mean for one, two in zip(found, true, strict=False)), model


def test_a_trials_outcome_under_all_models_is_set_by_the_trial_alone(flown):
    order = [TRIALS[k] for k in (4, 0, 5, 2)]
    sensors = load_sensors("all")
    for found in (results(order, sensors, slots=3), results(order[::-1], sensors)[::-1]):
        assert found == [flown[trial] for trial in order]


def test_the_reference_simulator_shows_the_same():
    models = {name: v._asdict() for name, v in load_sensors("all").models.items()}
    prompt = sensor_set({name: v for name, v in models.items() if name != "delay"})
    one, two = (results(TRIALS[:2], prompt, world=world) for world in ("mujoco", "reference"))
    for result, wanted in zip(two, one, strict=True):
        assert_alike(result._replace(world="mujoco"), wanted)


SPEC = PolicySpec(rate_hz=31.25, camera=Camera(width=4, height=4))
DELAY_S = 1.0 / SPEC.rate_hz
"""One period: the truth at the filter's horizon is what was seen at the decision before."""
TWO_TRACKS = [TrialSpec(track, 0, seed) for track in ("circular", "zigzag") for seed in range(20)]


def filtering(**changed):
    """Return the shipped sensors, with what is changed of the filter."""
    shipped = {k: values._asdict() for k, values in load_sensors("imu+gates").models.items()}
    return sensor_set({**shipped, "gate_filter": shipped["gate_filter"] | changed})


def filtered_flights(wanted, trials, monkeypatch, slots=40, seconds=1.6):
    """Return the results, and the NEES (T, N) of position, velocity and attitude."""
    found = []

    class Watched(Filtered):
        def see(self, view, truth, fresh, flying):
            seen = super().see(view, truth, fresh, flying)
            assert self.filters is not None and self._truth is not None
            past.append(View(*self._truth))
            if len(past) > 1:
                state, (pos_w, rot_w, vel_w, *_) = self.filters.state, past[-2]
                turned_b = rotation_since(rot_w, state.rot_w)
                error = np.hstack([pos_w - state.pos_w, vel_w - state.vel_w, turned_b])[..., None]
                covariance = state.covariance[:, :9, :9]
                value = (error * np.linalg.solve(covariance, error)).sum((1, 2))
                found.append(np.where(flying, value, np.nan))
            return seen

    past = []
    monkeypatch.setattr(judge, "Filtered", Watched)
    options = JudgeOptions(slots=slots, sensors=wanted, rules=Rules(time_limit_s=seconds))
    results = fly(Pursuit(spec=SPEC), trials, VEHICLE, options=options)
    return results, np.array(found)


@pytest.mark.parametrize(
    ("believed", "trials", "least", "most"),
    [more(1.0, 20, 0.9, 1.0), more(0.25, 5, 0.0, 0.5)],
)
def test_nees_is_within_its_bounds_if_the_corners_variance_is_right(
    monkeypatch, believed, trials, least, most
):
    def sure(state, corners, variance, camera_b):
        return update_gate(state, corners, believed * variance, camera_b)

    monkeypatch.setattr(sensors, "update_gate", sure)
    # From a second after the start on.
    late = filtered_flights(filtering(delay=DELAY_S), TWO_TRACKS[:trials], monkeypatch)[1][30:]
    flying = np.isfinite(late).sum(axis=1)
    low, high = (chi2.ppf(share, 9 * flying) / flying for share in (0.025, 0.975))
    mean = np.nanmean(late, axis=1)
    assert least <= np.mean((low < mean) & (mean < high)) <= most


def test_an_ideal_imu_reads_nothing_in_free_fall_and_the_turn():
    rng = np.random.default_rng(0)
    rot_w, turn_b = exp_rot(rng.normal(size=(5, 3))), 0.04 * rng.normal(size=(5, 3))
    none = (np.zeros((5, 3)),) * 4
    before = View(np.zeros((5, 3)), rot_w, np.ones((5, 3)), *none)
    fallen = np.ones((5, 3)) - [0.0, 0.0, 9.81 * 0.002]
    after = View(np.zeros((5, 3)), rot_w @ exp_rot(turn_b), fallen, *none)
    found = inertial(before, after, 0.002)
    np.testing.assert_allclose(found.acc_b, 0.0, atol=1e-9)
    np.testing.assert_allclose(found.rate_b, turn_b / 0.002, atol=1e-6)


@pytest.mark.extended
def test_a_trials_outcome_is_the_same_at_any_batch(monkeypatch):
    together, _ = filtered_flights(filtering(), TWO_TRACKS[:2], monkeypatch, 2, 0.3)
    alone, _ = filtered_flights(filtering(), TWO_TRACKS[:2], monkeypatch, 1, 0.3)
    assert together == alone


def test_an_estimator_with_another_delay_is_refused(monkeypatch):
    wanted = load_sensors("imu+gates")
    models = {name: values._asdict() for name, values in wanted.models.items()}
    late = sensor_set({**models, "delay": {"state": 0.02}})
    with pytest.raises(ValueError, match=r"delay.state is 0.02 s, but the estimator"):
        filtered_flights(late, TWO_TRACKS[:1], monkeypatch)
    Filtered(filtering(rate=500.0), 1, 1 / 500, SPEC.camera, 4)
    with pytest.raises(
        ValueError, match=r"gate_filter.rate is 500 Hz; allowed is up to the 200 Hz"
    ):
        Filtered(filtering(rate=500.0), 1, 1 / 200, SPEC.camera, 4)
