"""Kinds of action: who commands body rates or motors flies as who commands accelerations."""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

import suite
from eval.effects.interface import GRAVITY
from eval.judging.guard import ActionLimits, first_action, guard_action, limits_of
from eval.judging.judge import Record
from eval.judging.policy_checks.in_flight import Watched, action_report
from eval.logs.flight_log import log_from_flight, read_flight, write_flight
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules
from policies.spec import ActionSpec, NoAnswer, PolicySpec
from suite.common.console import Console
from suite.judging import checking
from suite.judging.checking import policy_findings
from tests.support.courses import end_of, fly_on, straight
from tests.support.judged_cells import cut_short
from tests.support.marks import more
from tests.support.pilots import Pursuit, Scripted, Steady

VEHICLE = load_vehicle("reference")
RULES = Rules(time_limit_s=0.8)


def flown(policy, world="mujoco", track=None, rules=RULES, vehicle=VEHICLE):
    how = {"vehicle": vehicle, "world": world, "slots": 1, "workers": 1, "rules": rules}
    return fly_on(policy, track or straight(), **how)[0][0]


def test_the_first_action_of_every_kind_carries_the_weight_and_turns_nothing():
    share = GRAVITY / VEHICLE.full_thrust
    for action, wanted in (
        (ActionSpec(), [0.0] * 3),
        (ActionSpec("ctbr"), [GRAVITY, 0.0, 0.0, 0.0]),
        (ActionSpec("motors"), [share] * 4),
        (ActionSpec("motors", motors="speed"), [share**0.5] * 4),
    ):
        np.testing.assert_allclose(first_action(action, VEHICLE), wanted)


@pytest.mark.parametrize(
    ("kind", "world"),
    [
        *(("ctbr", "mujoco"), ("motors", "reference")),
        *(more("ctbr", "reference"), more("motors", "mujoco")),
    ],
)
def test_hovering_by_any_kind_of_action_stays_where_it_is(kind, world):
    action = ActionSpec(kind, motors="speed")
    hover = Steady(tuple(first_action(action, VEHICLE)), PolicySpec(action=action))
    result = flown(hover, world)
    assert result.ended_by == "timeout" and result.v_max < 0.1 and result.limited_actions == 0


def climbing(kind):
    """Return a policy that climbs, under body rates in a turn as well."""
    action = ActionSpec(kind)
    more = [0.5, 0.3, 0.2, 0.0] if kind == "ctbr" else [0.05] * 4
    return Steady(tuple(first_action(action, VEHICLE) + more), PolicySpec(action=action))


@pytest.mark.parametrize(
    ("kind", "second"), [("ctbr", "action_roll_rate"), more("motors", "action_rotor_2")]
)
def test_flights_of_other_kinds_of_action_become_logs(kind, second, tmp_path):
    how = {"vehicle": VEHICLE, "slots": 1, "workers": 1, "record": Record()}
    for limit_s in (0.0, 1.2):
        how["rules"] = Rules(time_limit_s=limit_s)
        (flight,) = fly_on(climbing(kind), straight(height=30.0), **how)[1]
        log = log_from_flight(flight)
    log = read_flight(write_flight(tmp_path / "a.parquet", log))
    assert (log.extra[second] == flight.action_b[:, 1]).all() and (log.extra[second] > 0).any()
    assert (
        log.action_b is None and log.whole.all() and (log.thrust_cmd is None) == (kind == "motors")
    )


@pytest.mark.parametrize("world", ["mujoco", more("mjx")])
def test_a_log_has_a_row_at_every_new_command_of_body_rates(world):
    swinging = np.array([[GRAVITY, (-1) ** k * 0.2, 0.0, 0.0] for k in range(12)])
    policy = Scripted(swinging, PolicySpec(action=ActionSpec("ctbr")))
    how = {"vehicle": VEHICLE, "world": world, "slots": 1, "record": Record()}
    how["rules"] = Rules(time_limit_s=0.4)
    (flight,) = fly_on(policy, straight(height=30.0), **how)[1]
    new = np.flatnonzero(np.diff(flight.rate_cmd_b[:, 0])) + 1
    np.testing.assert_allclose(flight.time_s[new], np.rint(np.arange(1, 12) * 500 / 30) / 500)
    assert flight.policy_step[new].all()
    assert np.isin(np.arange(0, 200, 5), np.rint(500 * flight.time_s)).all()


@pytest.mark.parametrize(
    ("kind", "world", "off_m", "off_m_s"),
    [
        ("ctbr", "reference", 0.0, 0.0),
        more("motors", "reference", 0.0, 0.0),
        *(more(kind, "rotorpy", 0.002, 0.015) for kind in ("ctbr", "motors")),
    ],
)
def test_worlds_fly_commands_and_motors_alike(kind, world, off_m, off_m_s):
    policy = climbing(kind)
    track, rules = straight(height=30.0), Rules(time_limit_s=0.4)
    ours = flown(policy, "mujoco", track, rules)
    assert ours.v_max > 0.2
    theirs = flown(policy, world, track, rules)
    np.testing.assert_allclose(end_of(theirs), end_of(ours), rtol=0, atol=off_m)
    assert theirs.v_max == pytest.approx(ours.v_max, abs=off_m_s)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ctbr", "motors"])
def test_mjx_flies_commands_and_motors_as_mujoco_does(kind):
    policy, rules = climbing(kind), Rules(time_limit_s=0.6)
    track = straight(height=30.0)
    ends = [end_of(flown(policy, world, track, rules)) for world in ("mujoco", "mjx")]
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-3)


def test_limits_are_the_vehicle_files():
    limits = limits_of(ActionLimits(), ActionSpec("ctbr"), VEHICLE)
    most = VEHICLE.controller.rate_max
    asked, last = np.array([[99.0, 9.0, -9.0, 1.0]]), np.zeros((1, 4))
    found = guard_action(limits, asked, last, 0.0, "p")
    assert found.limited.all() and found.largest[0] == 99.0
    assert found.action_b[0] == pytest.approx([VEHICLE.full_thrust, most[0], -most[1], 1.0])
    found = guard_action(limits, np.array([[-1.0, 0.0, 0.0, 0.0]]), last, 0.0, "p")
    assert found.action_b[0].tolist() == [0.0] * 4 and found.limited.all()
    limits = limits_of(ActionLimits(), ActionSpec("motors", (0.5,), (0.5,)), VEHICLE)
    found = guard_action(limits, np.array([[-1.0, 0.0, 1.0, 2.0]]), last, 0.0, "p")
    assert found.action_b.tolist() == [[0.0, 0.5, 1.0, 1.0]] and found.limited.all()


def test_a_world_without_other_kinds_refuses_them(monkeypatch):
    from eval.worlds.mujoco import MujocoWorld

    monkeypatch.setattr(MujocoWorld, "actions", ())
    with pytest.raises(ValueError, match="supports no actions of kind 'ctbr'"):
        flown(Steady((9.81, 0, 0, 0), PolicySpec(action=ActionSpec("ctbr"))))


@pytest.mark.parametrize(("axis", "way"), [(0, (0, -1)), (1, (1, 0)), more(2, (0, 0))])
def test_rates_turn_the_body_about_its_own_axes(axis, way):
    """Roll tilts to the right (-y), pitch ahead (x): g rate t^3 / 6 after loop and rotors lag."""
    action = np.zeros(4)
    action[[0, 1 + axis]] = GRAVITY, 0.5
    policy = Steady(tuple(action), PolicySpec(action=ActionSpec("ctbr")))
    result = flown(policy, track=straight(height=30.0), rules=Rules(time_limit_s=0.6))
    lag_s = 1 / VEHICLE.controller.rate_gain[0] + VEHICLE.rotors.time_constant
    drift = GRAVITY * 0.5 * (0.6 - lag_s) ** 3 / 6
    np.testing.assert_allclose(end_of(result)[:2], drift * np.array(way), atol=0.1 * drift)


@dataclass
class Changed:
    """Pursuit whose output is what a mistake makes of it."""

    change: Callable[[np.ndarray], np.ndarray]
    spec: PolicySpec = PolicySpec()
    name: str = "changed"

    def start(self, n):
        return Pursuit().start(n)

    def act(self, hidden, state, image, fresh):
        action, hidden = Pursuit().act(hidden, state, image, fresh)
        return np.asarray(self.change(action), np.float32), hidden


@pytest.mark.parametrize(
    ("change", "action", "fault"),
    [
        (lambda a: a, ActionSpec(), None),
        (lambda a: a / 20, ActionSpec(), "action_scale"),
        (lambda a: a / 20, ActionSpec(scale=(20.0,)), None),
        (lambda a: 20 * a, ActionSpec(scale=(20.0,)), "action_limited"),
        (lambda a: a * [[1, np.nan, 1]], ActionSpec(), "action_not_finite"),
    ],
)
def test_mistakes_of_unit_are_reported_from_the_flights(change, action, fault):
    policy = Changed(change, PolicySpec(action=action))
    found = action_report([flown(policy)], action)
    assert [doubt.fault for doubt in found["warnings"]] == ([fault] if fault else [])
    assert found["decisions"] >= 5 and (found["limited"] > 0.5) == (fault == "action_limited")


@pytest.mark.extended
def test_a_scaled_policy_flies_as_the_plain_one():
    track = straight((0.5, 4.0))
    plain = flown(Changed(lambda a: a), track=track)
    spec = PolicySpec(action=ActionSpec(scale=(20.0,)))
    scaled = flown(Changed(lambda a: a / 20, spec), track=track)
    assert scaled.gates_passed == plain.gates_passed == 1
    assert scaled.pos_x == pytest.approx(plain.pos_x, abs=1e-4)


@pytest.mark.extended
def test_a_vehicle_too_heavy_to_climb_is_no_gravity_in_the_action():
    heavy = replace(VEHICLE, mass=2.7 * VEHICLE.mass)
    result = flown(Pursuit(), rules=Rules(time_limit_s=2.0), vehicle=heavy)
    assert result.pos_z < 1.0 and result.output_max > 6.0, result
    assert action_report([result], ActionSpec())["warnings"] == []


def test_gravity_in_the_action_shows_in_flight():
    found = action_report([flown(Steady((0.0, 0.0, 9.81)))], ActionSpec())
    assert "action_gravity" in [doubt.fault for doubt in found["warnings"]]


@pytest.mark.parametrize(
    ("fault", "change"),
    [
        more("", lambda a: a),
        ("no_gate", lambda a: a * np.array([-1, 1, 1], np.float32)),
        more("few_gates", lambda a: a * np.array([1, -0.2, 1], np.float32)),
        ("action_saturated", lambda a: 15 * np.sign(a)),
    ],
)
def test_short_flights_show_negated_axes_saturation_and_a_constant_memory(
    capsys, monkeypatch, fault, change
):
    seconds = 3.0 if fault.endswith("_gates") else 2.0
    monkeypatch.setattr(checking, "TIME_LIMIT_S", seconds)
    findings = policy_findings(Changed(change), 3, Console())
    found = [(finding.fault, finding.status) for finding in findings]
    notes = [("memory_constant", "note"), ("input_unused", "note")]
    assert found == [(fault, "doubt")] * bool(fault) + notes
    assert f"3 flights of {seconds:g} s at level 0 it passed" in capsys.readouterr().out
    assert ("race passes" in findings[0].evidence) == fault.endswith(("_gate", "_gates"))


@pytest.mark.filterwarnings("ignore:policy .* gave no action")
def test_an_error_in_a_short_flight_is_named_as_such(monkeypatch):
    monkeypatch.setattr(checking, "TIME_LIMIT_S", 0.2)
    monkeypatch.setattr(checking, "unused_inputs", lambda policy: [])

    class Failing(Pursuit):
        def act(self, hidden, state, image, fresh):
            if abs(state[:, 0]).max() > 0.01:
                raise NoAnswer("division by zero")
            return super().act(hidden, state, image, fresh)

    findings = policy_findings(Failing(), 3, Console())
    found = [finding for finding in findings if finding.status == "doubt"]
    assert [finding.fault for finding in found] == ["action_missing"]
    assert "in 3 of 3 flights it gave no action" in found[0].evidence


def test_without_a_decision_there_is_no_hint():
    assert not Watched(Steady()).hints()


@pytest.mark.extended
def test_from_python_the_doubts_of_suite_eval_are_warnings(monkeypatch):
    flown = cut_short(monkeypatch, 0.8)

    @dataclass
    class Own(Pursuit):
        factor: float = 1.0
        last_step: float = math.inf

        def act(self, hidden, state, image, fresh):
            hidden = np.where(fresh[:, None], np.float32(0), hidden) + np.float32(1)
            action, _ = super().act(hidden, state, image, fresh)
            factor = np.where(hidden[:, :1] > self.last_step, np.nan, self.factor)
            return (factor * action).astype(np.float32), hidden

    heavy = replace(VEHICLE, inertia=tuple(1000.0 * moment for moment in VEHICLE.inertia))
    for policy, vehicle, expected in (
        (Own(), "reference", []),
        (Own(factor=57.0), "reference", ["more than the limit"]),
        (Own(last_step=20.0), "reference", ["were not finite"]),
        (Own(), heavy, ["inertia about x or y is"]),
    ):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            suite.evaluate_policy(
                policy, track="zigzag", difficulty=0, trials=1, vehicle=vehicle, seed=3
            )
        said = [str(warning.message) for warning in caught]
        assert len(said) == len(expected), said
        assert all(text in line for text, line in zip(expected, said, strict=True)), said
        assert all(warning.filename == __file__ for warning in caught)
    assert len(flown) == 4
