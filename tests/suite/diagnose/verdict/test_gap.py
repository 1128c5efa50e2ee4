"""The gap, the model's own error in it, and measured rotor speeds against commanded ones."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from suite.diagnose.data.noise import Linearisation, Noise
from suite.diagnose.data.windows import CHANNELS, SLICES, STATE
from suite.diagnose.diagnose import diagnose
from suite.diagnose.estimate.parameters import Candidate
from suite.diagnose.estimate.permutation import CandidateScore
from suite.diagnose.evidence.rollouts import start_estimate
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.sources import input_error
from suite.diagnose.thresholds import THRESHOLDS
from suite.diagnose.verdict import actuators
from suite.diagnose.verdict import residual_structure as structure
from suite.diagnose.verdict.gap import EffectSize, Gap, gap_of, overlap, start_correction
from tests.support.diagnosis_flights import NOISE, fly, fly_all
from tests.support.vehicles import LAGGED, PLAIN, REMEMBERING, with_effects, with_lag


def covered(scores, **options):
    """Return how many intervals hold the true error of 1."""
    spans = [Gap(score, score, {}, **options).ci95(seed) for seed, score in enumerate(scores)]
    return sum(low <= 1.0 <= high for low, high in filter(None, spans))


def test_the_interval_of_few_stretches_is_no_point_and_one_of_three_decides_nothing():
    few = Gap(np.array([1.0, 1.0, 9.0]), np.zeros(3), {})
    low, high = few.ci95(0) or (0.0, 0.0)
    assert low < few.rms < high
    assert Gap(np.ones(1), np.ones(1), {}).ci95(0) is None
    before, after = (Gap(np.ones(3), np.array(e), {}) for e in ([0.0] * 3, [-10.0, -10.0, 400.0]))
    assert not after.exceeds(before, 0.25, THRESHOLDS)
    # Five independent stretches: a bootstrap is too narrow, but not useless.
    assert covered(np.random.default_rng(1).chisquare(20, (200, 5)) / 20) > 0.7 * 200


def test_errors_that_last_are_drawn_together():
    # 30 independent errors, each of 20 neighbouring moments.
    drawn = [np.random.default_rng(seed).chisquare(4, 30) / 4 for seed in range(50)]
    scores = np.repeat(drawn, 20, axis=1)
    assert covered(scores, together=4) < 37 and covered(scores, together=20) > 42


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
        rotor_valid=np.zeros((count, rows, 4), bool), input_error=None,
    )  # fmt: skip
    sigma = np.where(np.arange(CHANNELS) < STATE, 0.01, np.nan)
    slope = np.zeros((*valid.shape, 16))
    slope[..., np.arange(12), np.arange(12)] = 1.0
    seen = np.where(valid, residual, 0.0), np.where(valid[..., None], slope, 0.0)
    linear = Linearisation(*seen, np.zeros((count, 16)), windows)
    last = gap_of(linear, Noise(sigma, {})).channels["1 s"]
    assert last["position"].error == pytest.approx(0.99**2, rel=1e-6)
    assert last["velocity"].error == pytest.approx(2.0, rel=1e-6)


def test_rollouts_for_a_picture_start_from_states_that_fit_all_rows(flown, found_drag):
    """The noise of a measured start state would hide what the model explains."""
    found, windows = found_drag.search, flown.held
    theta, noise = found.estimate.theta, found.last.evidence.noise
    measured = start_estimate(flown.model, windows, theta)
    correction = start_correction(flown.model, theta, windows, noise, flown.limits)
    assert (np.abs(correction[:, :STATE]) <= 3.0 * noise.sigma[:STATE] + 1e-12).all()
    assert not correction[:, STATE:].any()
    position = SLICES["position"]
    rms = [
        np.sqrt((flown.model.residual(at, windows)[..., position] ** 2).mean())
        for at in (measured, measured._replace(free=measured.free + correction))
    ]
    assert rms[1] < 1.1 * noise.sigma[position].max() < 0.5 * rms[0]
    # Windows in which the model diverges keep the measured state.
    wrong = theta.copy()
    wrong[:] = np.nan
    assert not start_correction(flown.model, wrong, windows, noise, flown.limits).any()


def test_a_window_that_diverges_is_left_out_and_one_without_an_error_counts(monkeypatch):
    def block_of(_, linear, *__):
        return SimpleNamespace(residual=linear.residual.reshape(3, -1))

    monkeypatch.setattr(input_error, "block_of", block_of)
    errors = np.ones((3, 5, 19)) * np.array([2.0, 0.0, 1.0])[:, None, None]
    errors[2, 4, 7] = np.inf
    windows = SimpleNamespace(valid=np.ones(errors.shape, bool))
    linear = Linearisation(np.zeros_like(errors), *np.zeros((2, 0)), windows)
    rms = input_error._unexplained_rms(errors, linear, Noise(np.ones(19), {}), None)
    assert rms == pytest.approx(np.full(6, np.sqrt((2.0**2 + 0.0) / 2.0)))


def test_a_shape_that_grows_with_the_models_error_is_left_out_and_one_that_stays_is_kept():
    """Two windows, two knots; the model's error is an x force, the missing physics a z torque."""
    unit = np.zeros((2, 2, 6, 2))
    unit[..., 0, 0], unit[..., 5, 1] = [[1.0, 2.0], [3.0, 1.0]], [[2.0, 1.0], [1.0, 3.0]]
    unit = unit.reshape(2, 12, 2)
    hessian, names = np.tile(100.0 * np.eye(12), (2, 1, 1)), ("force", "torque")

    def of(error, physics):
        gradient = (hessian @ unit @ np.array([error, physics])[..., None])[..., 0]
        return structure.DisturbanceEquations(hessian, gradient, None, unit, {})

    fine, coarse = of(0.3, 0.2), of(0.9, 0.21)
    shapes = [CandidateScore(Candidate(n, (k,), n), 9.0, 5e-4, 0.0) for k, n in enumerate(names)]
    found = structure.ResidualStructure(shapes, {}, structure._size(fine, shapes))

    # RMS of both shapes over the knots, without the variance of the fitted coefficient.
    def rms(value):
        return pytest.approx(np.sqrt((value**2 - 1.0 / 1500.0) * 15.0 / 4.0))

    assert found.size == (rms(0.3), 0.0, None)
    # The model's own error is a share of the change from `fine` to `coarse`.
    least = {0.5: (0.0, rms(0.2 - 0.5 * 0.01), None), 0.1: (rms(0.3 - 0.1 * 0.6), 0.0, None)}
    for share, kept in ((0.5, ["torque"]), (0.1, ["force", "torque"])):
        left = structure.beyond_model_error(found, fine, coarse, share)
        assert [shape.candidate.label for shape in left.shapes] == kept
        assert left.size == least[share]
    by_chance = found._replace(
        shapes=[found.shapes[0]._replace(p_value=0.2)], size=EffectSize(0.0, 0.0, None)
    )
    assert structure.beyond_model_error(by_chance, fine, coarse, 0.5) == by_chance


@pytest.fixture(scope="module")
def log():
    return fly(LAGGED, 0, duration_s=2.5, motors=True)


def with_speeds(log, speed):
    return replace(log, rotor_speed=speed)


@pytest.mark.parametrize(("lag", "delay"), [(0.03, 0.0), (0.05, 0.012)])
def test_lag_and_delay_are_estimated_separately(lag, delay):
    truth = with_effects(with_lag(PLAIN, lag), command_delay=(delay,))
    logs = fly_all([truth] * 2, range(2), duration_s=2.0, motors=True)
    (found,) = actuators.actuator_mismatches(logs, LAGGED)
    assert found.commanded_by == "nominal rate loop"
    both, accuracy = (found.time_constant, found.delay), 2e-3 if delay else 1e-3
    assert both == pytest.approx((lag, delay), abs=accuracy)
    if delay:
        assert found.rms > 2.0 * found.rms_fitted
        # With lag and delay among the effects of the file, it explains the speeds.
        given = with_effects(LAGGED, motor_lag=(lag,), command_delay=(delay,))
        (own,) = actuators.actuator_mismatches(logs, given)
        assert own.followed > 0.99 > found.followed and own.rms < 1.3 * NOISE["motor"]
    else:
        assert found.followed > 0.99 and found.rms < 1.3 * NOISE["motor"]
        assert abs(found.thrust[0]) < 0.02
        np.testing.assert_allclose(found.scale, 1.0, atol=1e-3)


def test_a_rotor_that_does_not_reach_its_speed_is_seen_also_by_logged_motor_commands(log):
    share = np.array([1.0, 0.97, 1.0, 1.0])
    (found,) = actuators.actuator_mismatches([with_speeds(log, log.rotor_speed * share)], LAGGED)
    np.testing.assert_allclose(found.scale, share, atol=2e-3)
    # A quarter of the thrust falls by 6 %.
    lost = (1.0 - 0.97**2) * log.thrust_cmd.mean() / 4.0
    assert found.thrust[0] == pytest.approx(-lost, rel=0.1)
    commanded = replace(log, rotor_speed_cmd=log.rotor_speed / 0.9)
    found = actuators.actuator_mismatches([commanded], with_lag(PLAIN, 0.0))
    logged = {one.commanded_by: one for one in found}["logged motor commands"]
    np.testing.assert_allclose(logged.scale, 0.9, atol=5e-3)


def test_logs_without_speeds_give_no_mismatch_and_speeds_of_another_controller_are_its_own(log):
    assert actuators.actuator_mismatches([with_speeds(log, None)], LAGGED) == []
    row = np.arange(len(log.time_s))[:, None]
    holes = np.where((row % 20 == 0) | ((row >= 5) & (row < 60)), np.nan, log.rotor_speed)
    assert len(actuators.actuator_mismatches([with_speeds(log, holes)], LAGGED)) <= 1
    assert actuators.actuator_mismatches([with_speeds(log, np.nan * log.rotor_speed)], LAGGED) == []
    other = with_speeds(log, np.roll(log.rotor_speed, 1, axis=1))
    assert actuators.flown_by_other_controller([other], LAGGED)
    assert not actuators.flown_by_other_controller([with_speeds(log, None)], LAGGED)
    truth = with_effects(LAGGED, com_offset=((0.006, -0.004, 0.0),))
    moved = fly(truth, 0, duration_s=2.0, motors=True)
    assert not actuators.flown_by_other_controller([moved], LAGGED)


def test_columns_and_rate_loop_decide_what_can_be_the_input(log):
    no_motors = with_speeds(log, None)
    no_commands = replace(log, thrust_cmd=None, rate_cmd_b=None)
    assert not actuators.rotors_are_input([log], "auto", LAGGED)
    assert actuators.rotors_are_input([log], "motors", LAGGED)
    assert actuators.rotors_are_input([log, no_commands], "auto", LAGGED)
    assert actuators.rotors_are_input([log], "auto", REMEMBERING)
    for logs, drive, vehicle, message in (
        ([log, no_motors], "motors", LAGGED, "not every flight"),
        ([no_motors, no_commands], "auto", LAGGED, "diagnose each kind alone"),
        ([log], "wheels", LAGGED, "auto, commands, motors"),
        ([log], "commands", REMEMBERING, "state of its crazyflie rate loop"),
        ([no_motors], "auto", REMEMBERING, "state of its crazyflie rate loop"),
    ):
        with pytest.raises(ValueError, match=message):
            actuators.rotors_are_input(logs, drive, vehicle)


@pytest.fixture(scope="module")
def slow():
    truth = with_effects(LAGGED, motor_lag=(0.06,), linear_drag=((0.4, 0.4, 0.2),))
    return fly_all([truth] * 3, range(3), duration_s=3.0, motors=True)


@pytest.mark.extended
def test_a_longer_rotor_lag_is_named_next_to_what_the_views_name(slow):
    found = diagnose(slow, LAGGED, by="views")
    written = diagnosis_json(found)
    effects = {effect["name"]: effect for effect in written["effects"]}
    lag, entry = effects["motor_lag"], effects["motor_lag"]["parameters"]["time_constant"]
    low, high = entry["ci95"]
    assert "linear_drag" in effects and 0.056 < low < 0.06 < high < 0.064
    assert lag["gap_removed"] > 0.9 and lag["p_value"] < 0.01
    assert found.vehicle.effects["motor_lag"].time_constant == entry["value"]
    assert written["verdict"] in ("named", "partly") and "(motor_lag)" in written["headline"]


def test_a_lag_is_named_only_where_it_differs_and_flights_identify_it(slow):
    found = actuators.find_rotor_lag(slow, LAGGED)
    assert found is not None
    calm = fly_all([LAGGED], [7], duration_s=2.0, speed=0.3, motors=True)
    assert actuators.find_rotor_lag([*slow, *calm], LAGGED) == found, "its speeds hardly change"
    own = fly_all([LAGGED] * 3, range(3), duration_s=2.0, motors=True)
    rng = np.random.default_rng(0)
    shaken = [one.rotor_speed + 60.0 * rng.standard_normal(one.rotor_speed.shape) for one in slow]
    noisy = [with_speeds(*both) for both in zip(slow, shaken, strict=True)]
    for logs, vehicle, reason in (
        (own, LAGGED, "the file's lag"),
        (slow, with_effects(LAGGED, motor_lag=(0.06,)), "the lag of its effect"),
        (slow, with_lag(LAGGED, 0.06), "the lag of its rotors"),
        (slow[:2], LAGGED, "two flights"),
        ([with_speeds(log, None) for log in slow], LAGGED, "no speeds"),
        (slow, with_lag(REMEMBERING, 0.03), "a loop with a state"),
        (noisy, LAGGED, "speeds that the commands do not explain"),
    ):
        assert actuators.find_rotor_lag(logs, vehicle) is None, reason
