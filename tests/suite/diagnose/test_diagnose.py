"""The diagnosis on flights made by MuJoCo: nulls stay null, effects are named, wrong ones lose.

Every effect of the catalogue, hidden at a usual size, is named alone; broken logs end in a verdict
with warnings or in an error that says what is wrong.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eval.effects import EFFECTS, nameable_effects
from eval.flights.simulate import SENSORS, log_of
from eval.flights.simulate import fly as fly_ways
from eval.flights.trajectory import ordinary_flights
from eval.logs.flight_log import read_flight
from eval.quadrotor.loops import KINDS
from suite.common.report import html
from suite.diagnose.diagnose import diagnose
from suite.diagnose.estimate.parameters import candidates, make_space
from suite.diagnose.evidence.rollouts import is_hopeless, rollouts_along
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.report.page import page
from suite.diagnose.sources import rollout_source, rollouts, stretches
from suite.diagnose.sources.source import DiagnosisInput
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from tests.support import diagnosis_flights
from tests.support.broken_logs import BREAKAGES, rows, with_sent_commands
from tests.support.diagnosis_flights import fly, fly_all
from tests.support.real_flights import Pendulum
from tests.support.vehicles import LAGGED, PLAIN, REMEMBERING, with_effects, with_lag
from tracks.common.files import plain, to_json


def flights(vehicle, seed=0, count=3, duration_s=7.0, **options):
    return fly_all([vehicle] * count, range(seed, seed + count), duration_s, **options)


def by_rollout(logs, vehicle=LAGGED, **options):
    """Return the JSON of a diagnosis by rollouts."""
    return diagnosis_json(diagnose(logs, vehicle, by="rollouts", **options))


def test_flights_of_the_vehicle_itself_have_no_gap():
    found = by_rollout(flights(LAGGED, duration_s=3.5))
    assert (found["verdict"], found["effects"]) == ("no_gap", [])
    assert 0.8 < found["gap"]["before"] < 1.2


@pytest.mark.extended
def test_without_noise_rollouts_near_a_flight_are_no_hopeless_ones():
    """A fin that no effect of the catalogue has moves the vehicle by many times no noise."""

    def fin(motion, t):
        side_w = motion.rot_w[:, 1]
        speed = float(motion.vel_w @ side_w)
        return -0.02 * abs(speed) * speed * side_w

    logs = flights(LAGGED, count=2, duration_s=3.0, noise=0.0, motors=True, extras=[fin] * 2)
    model, windows, start = rollouts_along(logs, LAGGED, False, integrator="euler")
    linear = model.linearise(start, windows)
    assert not is_hopeless(model, linear, THRESHOLDS)
    assert is_hopeless(model, linear, replace(THRESHOLDS, hopeless_m=0.0))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_behind_firmware_rate_loops_little_is_named_where_nothing_is_hidden(kind):
    """And what is hidden is; docs/results.md has what it says."""
    controller = replace(REMEMBERING.controller, kind=kind, settings=KINDS[kind].Settings())
    nominal = with_lag(replace(REMEMBERING, controller=controller), 0.03)

    def names(seed, **effects):
        logs = flights(with_effects(nominal, **effects), seed=seed, motors=True)
        found = diagnosis_json(diagnose(logs, nominal))
        return {effect["name"]: effect["parameters"] for effect in found["effects"]}

    assert sum(bool(names(seed)) for seed in range(100, 160, 10)) <= 1
    for seed in (100, 110, 120):
        mass = names(seed, mass_offset=(0.05,))["mass_offset"]["offset"]["value"]
        assert mass == pytest.approx(0.05, rel=0.1)
        drag = names(seed, linear_drag=((0.2, 0.2, 0.1),))["linear_drag"]["coefficient"]["value"]
        np.testing.assert_allclose(drag, (0.2, 0.2, 0.1), atol=0.03)


@pytest.mark.slow
def test_a_force_outside_the_catalogue_is_not_called_by_a_name_alone():
    def swing(motion, t):
        return np.array([0.8 * np.sin(2 * np.pi * 1.3 * t), 0.8 * np.cos(2 * np.pi * 1.1 * t), 0.0])

    # With a drag beside it, which is named first and leaves too much to stand.
    truth = with_effects(LAGGED, linear_drag=((0.15, 0.15, 0.05),))
    logs = flights(truth, duration_s=5.0, extras=[swing] * 3)
    found = by_rollout(logs, limits=Thresholds(unexplained_share=0.0, most_names=1))
    assert found["verdict"] == "unknown" and found["effects"] == []
    assert any(text.startswith("nearest in the catalogue") for text in found["warnings"])
    # What is left is what nothing that was withdrawn has taken away.
    assert found["unexplained"]["share"] == 1.0 and found["unexplained"]["where"]
    assert found["gap"]["after"] == found["gap"]["before"]


@pytest.mark.slow
def test_a_payload_is_its_mass_and_where_it_sits(ways):
    payload = {"mass_offset": (0.06,), "com_offset": ((0.005, -0.003, 0.0),)}
    truth = with_effects(GIVEN, **DRAG, **payload)
    found = by_rollout(logged(truth, ways, 9), GIVEN)
    effects = {effect["name"]: effect for effect in found["effects"]}
    heavy = effects.pop("mass_offset", None) or effects.pop("thrust_scale")
    assert {heavy["name"], *heavy["alternatives"]} <= {"mass_offset", "thrust_scale"}
    assert set(effects) == {"com_offset"} and found["verdict"] == "named"
    ahead, left, _ = effects["com_offset"]["parameters"]["offset"]["value"]
    assert (ahead, left) == pytest.approx((0.005, -0.003), rel=0.1)
    if heavy["name"] == "mass_offset":
        assert heavy["parameters"]["offset"]["value"] == pytest.approx(0.06, rel=0.1)


@pytest.mark.slow
def test_a_load_on_a_line_is_said_to_swing():
    loads = [Pendulum(0.08, 0.5, LAGGED.mass) for _ in range(3)]
    logs = fly_all([LAGGED] * 3, range(3), 8.0, speed=1.5, extras=loads)
    # Without names, for the search takes longer than what is asked here.
    found = by_rollout(logs, limits=Thresholds(most_names=0))
    assert found["verdict"] == "unknown"
    assert "oscillates with a period of 1." in found["unexplained"]["where"]


def test_where_another_controller_flew_every_log_needs_rotor_speeds(monkeypatch):
    monkeypatch.setattr(rollouts, "flown_by_other_controller", lambda *_: True)
    logs = [fly(LAGGED, seed, duration_s=2.0, motors=seed > 0) for seed in range(2)]
    with pytest.raises(ValueError, match=f"{logs[0].name} has none as an input: diagnose the"):
        diagnose(logs, LAGGED)


@pytest.fixture(scope="module")
def sound(diagnosed):
    paths = [diagnosed[0].parent / f"{k}.parquet" for k in range(3)]
    return [rows(read_flight(path), slice(401)) for path in paths]


def outcome(logs, drive="commands", limits=THRESHOLDS):
    """The JSON of a diagnosis that went through all its steps, or the message of its refusal."""
    try:
        result = diagnose(logs, LAGGED, by="rollouts", drive=drive, limits=limits)
    except np.linalg.LinAlgError:  # a ValueError too, but no message for a user
        raise
    except ValueError as error:
        assert len(str(error)) > 20
        return str(error)
    found = diagnosis_json(result)
    text = to_json(plain(found))
    assert "NaN" not in text and "Infinity" not in text
    assert "<h2>" in html(page(result, json.loads(text), "", set()))
    assert found["verdict"] in ("no_gap", "named", "partly", "unknown")
    assert np.isfinite(found["gap"]["before"]) and np.isfinite(found["gap"]["after"])
    return found


@pytest.mark.extended
def test_broken_flights_among_sound_ones(sound):
    rng = np.random.default_rng(0)
    broken = [breakage(log, rng) for breakage, log in zip(BREAKAGES[-3:], sound, strict=True)]
    quick = Thresholds(most_names=1, short_list=1, settle_rounds=0, last_rounds=1, sign_draws=499)
    found = outcome([*broken, sound[1]], limits=quick)
    assert isinstance(found, dict), found


@pytest.mark.slow
def test_flights_broken_in_several_ways(sound):
    @settings(max_examples=80)
    @given(
        st.lists(st.sampled_from(BREAKAGES), min_size=1, max_size=4),
        st.sampled_from(["commands", "motors", "auto"]),
        st.booleans(),
        st.integers(0, 2**16),
    )
    def check(breakages, drive, alike, seed):  # without `sound`, which a failure would print
        rng = np.random.default_rng(seed)
        logs = list(sound)
        for breakage in breakages:
            for k in range(len(logs)) if alike else [int(rng.integers(len(logs)))]:
                if len(logs[k].time_s) > 30:
                    logs[k] = breakage(logs[k], rng)
        outcome(logs, drive)

    check()


DRAG = {"linear_drag": ((0.3, 0.25, 0.15),), "quadratic_drag": ((0.012, 0.016, 0.03),)}
GIVEN = with_effects(with_lag(PLAIN, 0.02), **DRAG)
HIDDEN = {
    "linear_drag": ((0.4, 0.3, 0.2),),
    "quadratic_drag": ((0.02, 0.02, 0.03),),
    "rotor_drag": (2e-5,),
    "inflow": (5e-5,),
    "translational_lift": (0.01,),
    "blade_flapping": (5e-7,),
    "ground_effect": (4.0, 0.0635),
    "constant_wind": ((1.5, -1.0, 0.5),),
    "gusts": (0.8, 5.0),
    "motor_lag": (0.035,),
    "command_delay": (0.01,),
    "thrust_scale": (0.95,),
    "battery_sag": (0.005, 0.0),
    "mass_offset": (0.05,),
    "com_offset": ((0.004, -0.003, 0.0),),
    "torque_trim": ((0.003, -0.002, 0.001),),
    "inertia_scale": ((1.15, 0.9, 1.1),),
    "rotor_gyroscopic": (2e-5,),
    "rotor_spin_up": (5e-6,),
    "rate_gain": ((0.85, 0.9, 1.1),),
    "angular_damping": ((0.6, 0.6, 0.4),),
    "weak_motor": ((1.0, 0.94, 1.0, 1.0),),
    "thrust_tilt": ((0.01, -0.008),),
    "lever_arm": ((0.02, -0.01, 0.015),),
    "attitude_offset": ((0.02, -0.03, 0.05),),
    "gyro_bias": ((0.02, -0.01, 0.015),),
    "accelerometer_bias": ((0.15, -0.1, 0.1),),
    "frame_tilt": ((0.01, 0.008),),
    "clock_offset": (0.008,),
}
ALIKE = {
    "mass_offset": {"thrust_scale"},
    "thrust_scale": {"mass_offset"},
    "rotor_drag": {"linear_drag"},
}
"""What half a minute of flight may leave open."""


@pytest.fixture(scope="module")
def ways():
    return ordinary_flights(np.random.default_rng(5), duration_s=5.5)


def logged(truth, ways, seed):
    """Return what an estimator logs of flights of `truth`, which the controller takes for GIVEN."""
    rng, sensors = np.random.default_rng(seed), SENSORS["estimator"]
    flights = fly_ways(GIVEN, truth, ways, sensors.rate_hz, rng=rng)
    return [log_of(flight, truth, sensors, rng, f"flight_{k}") for k, flight in enumerate(flights)]


def test_every_effect_is_a_candidate_and_tested():
    assert set(HIDDEN) == set(nameable_effects())
    among = candidates(make_space(GIVEN), True, ("acc_b", "command"))
    # Gusts have no fitted parameter but a test of their own.
    assert {candidate.name for candidate in among} >= set(HIDDEN) - {"gusts"}


@pytest.mark.slow
@pytest.mark.parametrize("name", HIDDEN)
def test_an_effect_is_named_alone(name, ways):
    truth = with_effects(GIVEN, **{**DRAG, name: HIDDEN[name]})
    logs = logged(truth, ways, list(EFFECTS).index(name))
    # Of any size: some are below the default thresholds of relevance.
    found = by_rollout(logs, GIVEN, limits=Thresholds(relevance=(0.0, 0.0, 0.0)))
    assert found["verdict"] in ("named", "partly"), found["unexplained"]
    assert [effect["name"] for effect in found["effects"]] == [name]
    (effect,) = found["effects"]
    assert set(effect["alternatives"]) <= ALIKE.get(name, set())
    if name != "gusts":
        assert found["gap"]["after"] < 1.2
    parameter = EFFECTS[name].parameters[0].name
    if name == "weak_motor":
        assert effect["parameters"]["index"]["value"] == 2
        assert effect["parameters"]["scale"]["value"] == pytest.approx(0.94, abs=0.005)
        return
    value = np.array(effect["parameters"][parameter]["value"], dtype=float)
    true, neutral = HIDDEN[name][0], getattr(GIVEN.effects.get(name), parameter, 0.0)
    scale = np.abs(np.subtract(true, neutral)).max()
    assert np.nanmax(np.abs(value - true)) < (0.5 if name == "gusts" else 0.15) * scale


@pytest.mark.slow
@pytest.mark.parametrize(
    ("vehicle", "drive"), [(PLAIN, "commands"), (LAGGED, "commands"), (LAGGED, "motors")]
)
def test_without_noise_the_models_own_error_is_no_finding(vehicle, drive):
    """What rotor speeds do between rows of 100 Hz looks like 0.5 % less inertia."""
    logs = flights(vehicle, duration_s=6.0, noise=0.0, motors=True)
    found = diagnosis_json(diagnose(logs, vehicle, drive=drive))
    assert (found["verdict"], found["effects"]) == ("no_gap", [])


def slow_and_complete(monkeypatch, vehicle=LAGGED, **options):
    """Return flights with every second of their commands, and flights as slow with all."""
    sparse = [rows(log, slice(0, None, 2)) for log in flights(vehicle, noise=0.1, **options)]
    with monkeypatch.context() as patch:
        patch.setattr(diagnosis_flights, "ROW_HZ", 50.0)
        return sparse, flights(vehicle, noise=0.1, **options)


@pytest.mark.slow
def test_commands_between_the_rows_of_a_log_are_no_effect(monkeypatch):
    """If the log has every command, its slow rows limit nothing."""
    uncertain = list[bool]()
    monkeypatch.setattr(rollout_source.RolloutSource, "is_relevant", lambda *_: True)
    monkeypatch.setattr(rollout_source, "structure_where", lambda *got: uncertain.append(got[2]))
    pairs = zip(slow_and_complete(monkeypatch, duration_s=5.0), (True, False), strict=True)
    for logs, lacks in pairs:
        found = diagnose(logs, LAGGED, drive="commands")
        assert (found.verdict.label, found.named) == ("no_gap", [])
        assert (stretches.LACKING in found.warnings) == lacks
    assert uncertain == [True, False], "the noise counts as certain only if no command is lacking"


@pytest.mark.extended
def test_the_noise_counts_as_certain_only_if_no_command_is_lacking(monkeypatch):
    """If the log has every command, its slow rows limit nothing."""
    say, limits = lambda line: None, Thresholds()

    def source_of(logs):
        given = DiagnosisInput(logs, LAGGED, (), "commands", "auto", say, limits, True)
        made = rollouts.by_rollouts(given)
        return made.sources[0], stretches.LACKING in made.warnings

    sparse, complete = slow_and_complete(monkeypatch, count=2, duration_s=6.0)
    source, lacks = source_of(sparse)
    assert lacks and source.coarser is not None and source.coarser_share == 2.0
    assert sum(source.limits.least_noise) > sum(limits.least_noise)
    assert source.held.input_error.any(axis=(1, 2)).all() and source.cut.keywords["between"]
    stated = [replace(log, about={**log.about, "command_jitter_s": 0.0}) for log in sparse]
    with monkeypatch.context() as patch:
        patch.setattr(stretches, "share_between", None)
        assert not source_of(stated)[1], "a log with the times of commands has all of them"
    source, lacks = source_of(complete)
    assert not lacks and source.coarser is None and source.limits == limits

    def lift(motion, t):
        """No effect of the catalogue gives this acceleration."""
        return np.array([0.0, 0.0, 0.03 * float(motion.vel_w[:2] @ motion.vel_w[:2])])

    shifted = with_effects(LAGGED, clock_offset=(-0.004,))
    for vehicle, extras in ((shifted, None), (LAGGED, [lift] * 2)):
        options = {"count": 2, "duration_s": 6.0, "extras": extras}
        sparse, complete = slow_and_complete(monkeypatch, vehicle, **options)
        assert source_of(sparse)[1] and not source_of(complete)[1]


@pytest.mark.extended
def test_an_effect_at_the_threshold_of_relevance_is_named_without_half_of_the_commands():
    true = with_effects(LAGGED, linear_drag=((0.02, 0.02, 0.02),))
    logs = flights(true, count=3, duration_s=6.0, noise=0.1)
    found = diagnose([rows(log, slice(0, None, 2)) for log in logs], LAGGED, drive="commands")
    assert stretches.LACKING in found.warnings
    assert [one.candidate.name for _, one in found.named] == ["linear_drag"]
    ((effect, size),) = found.main.sizes.items()
    assert effect == "linear_drag" and size.force < 2.0 * THRESHOLDS.relevance[0]


@pytest.mark.extended
def test_times_of_commands_are_as_uncertain_as_a_log_states():
    """As in the logs of `suite fly`: commands act later than logged, by more or less."""
    true, count = with_effects(LAGGED, command_delay=(0.004,)), 3
    logs, rng = flights(true, count=count, duration_s=5.0, noise=0.0), np.random.default_rng(0)
    late_s = rng.uniform(0.0005, 0.0075, (count, len(logs[0].time_s)))
    sent = [with_sent_commands(*one) for one in zip(logs, late_s, strict=True)]
    jitter_s = float(late_s.std())
    stated = [replace(log, about={**log.about, "command_jitter_s": jitter_s}) for log in sent]
    as_exact, as_stated = by_rollout(sent), by_rollout(stated)
    assert as_exact["gap"]["before"] > 5.0 * as_stated["gap"]["before"]
    assert (as_stated["verdict"], as_stated["effects"]) == ("no_gap", [])


@pytest.mark.slow
def test_what_a_rate_loop_does_between_rows_is_no_inertia_next_to_a_drag():
    """Without a lag rows of 100 Hz look like 8 % less inertia, on three stretches."""
    true = with_effects(PLAIN, linear_drag=((0.3, 0.3, 0.1),))
    log = fly(true, 0, duration_s=6.0, noise=0.1, motors=True)
    found = diagnose([replace(log, thrust_cmd=None, rate_cmd_b=None)], PLAIN)
    assert [name.candidate.name for _, name in found.named] == ["linear_drag"]
    assert any("no larger than the model's own error" in line for line in found.warnings)
