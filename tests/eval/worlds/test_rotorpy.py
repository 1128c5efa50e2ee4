"""The world rotorpy: what of it stands without RotorPy, and trials in it where it is installed."""

import builtins
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from eval.judging.judge import JudgeOptions, Record, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds import differences, world_class
from eval.worlds import rotorpy as rotorpy_world
from eval.worlds.rotorpy import Multirotor, StepInput
from eval.worlds.trial import Rules, TrialSpec
from suite.cli import main
from tests.support.courses import straight
from tests.support.engines import STAND_IN
from tests.support.pilots import Pursuit, RandomNetwork, Steady
from tests.support.vehicles import PLAIN, with_effects, with_lag

VEHICLE = load_vehicle("reference")
TRACK = straight()
RULES = Rules(time_limit_s=4.0)


def one(policy, track=TRACK, vehicle=VEHICLE, record=None, rules=RULES):
    flights = []
    (result,) = fly(
        policy,
        [TrialSpec(track.family, 0, 0)],
        vehicle,
        "rotorpy",
        JudgeOptions(slots=3, rules=rules),
        lambda _, flight: flights.append(flight),
        record,
        {track.family: track},
    )
    return result, flights[0]


@pytest.fixture
def stand_in(monkeypatch):
    monkeypatch.setattr(rotorpy_world, "rotorpy", lambda: STAND_IN)


@pytest.mark.parametrize("missing", ["rotorpy", "roma"])
def test_without_rotorpy_the_install_line_is_said(missing, monkeypatch, tmp_path, capsys):
    monkeypatch.delitem(sys.modules, "rotorpy.vehicles.multirotor", raising=False)
    for name in ("rotorpy", "rotorpy.vehicles", "torchdiffeq", "roma"):
        if name.startswith(missing):
            monkeypatch.setitem(sys.modules, name, None)
        elif name not in sys.modules:
            monkeypatch.setitem(sys.modules, name, builtins)
    line = "pip install 'diffracing-suite[rotorpy]'"
    with pytest.raises(ValueError, match="world 'rotorpy' needs the package") as refused:
        world_class("rotorpy")
    assert line in str(refused.value)
    assert main(["eval", "--simulator", "rotorpy", "--out", str(tmp_path / "out")]) == 2
    assert line in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_the_body_falls_as_the_simulator_says_and_touches_our_ground(stand_in):
    result, _ = one(Steady())
    assert (result.ended_by, result.collided_with, result.world) == (
        "collision", "ground", "rotorpy",
    )  # fmt: skip
    assert result.time_s == pytest.approx(np.sqrt(2 * 1.475 / 9.81), abs=0.003)
    assert torch.get_default_dtype() is torch.float32, "left as it was"


def test_rows_are_the_simulators_states_and_count_as_continuous(stand_in):
    _, flight = one(Steady(), record=Record())
    t = flight.time_s
    np.testing.assert_allclose(flight.pos_w[:, 2], 1.5 - 0.5 * 9.81 * t**2, atol=1e-9)
    np.testing.assert_allclose(flight.vel_w[:, 2], -9.81 * t, atol=1e-9)
    assert "integrator" not in flight.about and flight.about["world"] == "rotorpy"


def test_a_state_that_is_none_ends_that_trial_only(stand_in, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo would leave its log here
    step = Multirotor.step

    def broken(self, qpos, qvel, speed, push):
        after, *rest = step(self, qpos, qvel, speed, push)
        return np.where((qpos[:, 2] < 5.0)[:, None], np.nan, after), *rest

    monkeypatch.setattr(Multirotor, "step", broken)
    high, low = straight(height=30.0, name="high"), straight(height=5.5, name="low")
    trials = [TrialSpec("high", 0, 0), TrialSpec("low", 0, 0)]
    ends = fly(
        Steady(), trials, VEHICLE, "rotorpy", JudgeOptions(slots=3, rules=Rules(time_limit_s=1.0)),
        tracks={"high": high, "low": low},
    )  # fmt: skip
    assert [end.ended_by for end in ends] == ["timeout", "diverged"]
    assert 4.9 < ends[1].pos_z < 5.1 and list(tmp_path.iterdir()) == []


def test_what_the_vehicle_loses_is_said(stand_in):
    lame = with_effects(with_lag(PLAIN, 0.03), weak_motor=((0.8, 1.0, 1.0, 1.0),))
    assert differences("rotorpy", lame) == ["weak_motor: RotorPy does not have it; flown without"]
    assert differences("mujoco", lame) == []


# From here on RotorPy itself flies.


@pytest.fixture
def installed():
    pytest.importorskip("rotorpy")
    pytest.importorskip("torchdiffeq")


def test_one_trial_is_finished_and_another_ends_at_a_wall(installed):
    clear, walled = straight((1.0, 2.0), name="clear"), straight((4.0, 5.0), 1.2, name="walled")
    flights = {}
    result, hit = fly(
        Pursuit(3.0),
        [TrialSpec("clear", 0, 0), TrialSpec("walled", 0, 0)],
        VEHICLE,
        "rotorpy",
        JudgeOptions(slots=2, rules=RULES),
        lambda found, flight: flights.update({found.trial.track: flight}),
        Record(depth=True),
        {"clear": clear, "walled": walled},
    )
    flight = flights["clear"]
    assert (hit.ended_by, hit.collided_with) == ("collision", "the wall")
    assert (result.ended_by, result.gates_passed, result.gates_035) == ("finished", 2, 2)
    assert 1.0 < result.v_mean < result.v_max < 3.5
    assert flight.depth_m.shape[1:] == (24, 32)
    assert np.ptp(flight.rotor_speed[1:], axis=0).min() > 10.0


@pytest.mark.slow
def test_wind_carries_the_vehicle_by_rotorpys_drag(installed):
    rules = Rules(time_limit_s=0.4)
    still, _ = one(Steady(), rules=rules)
    wind = with_effects(constant_wind=((0.0, 4.0, 0.0),)).effects
    blown = replace(VEHICLE, effects={**VEHICLE.effects, **wind})
    carried, _ = one(Steady(), vehicle=blown, rules=rules)
    assert abs(still.pos_y) < 1e-6 and carried.pos_y > 0.02


@pytest.mark.slow
def test_outcomes_are_the_same_bits_at_any_place_in_any_batch(installed):
    policy, rules = RandomNetwork(), Rules(time_limit_s=0.6)
    wind = with_effects(gusts=(2.0, 5.0)).effects
    gusty = replace(VEHICLE, effects={**VEHICLE.effects, **wind})
    trials = [TrialSpec(t, 9, seed) for t in ("zigzag", "ellipse") for seed in range(3)]

    def flown(order, slots):
        options = JudgeOptions(slots=slots, workers=1, rules=rules)
        results = fly(policy, order, gusty, "rotorpy", options)
        return {result.trial: result for result in results}

    first = flown(trials, 6)
    assert flown(trials[::-1], 6) == first
    assert flown(trials, 4) == first


@pytest.mark.parametrize("count", [1, 3])
def test_a_row_is_stepped_by_itself(installed, count):
    rng = np.random.default_rng(0)
    qpos = rng.normal(size=(64, 7))
    qpos[:, 3:] /= np.linalg.norm(qpos[:, 3:], axis=1, keepdims=True)
    qvel, speed = rng.normal(0, 4, (64, 6)), rng.uniform(300, 1800, (64, 4))
    push = StepInput(rng.uniform(300, 1800, (64, 4)), rng.normal(size=(64, 3)))
    whole = Multirotor(VEHICLE, 0.002, 64).step(qpos, qvel, speed, push)
    few = Multirotor(VEHICLE, 0.002, count).step(
        qpos[:count], qvel[:count], speed[:count], StepInput(*(part[:count] for part in push))
    )
    for part, of_few in zip(whole, few, strict=True):
        np.testing.assert_array_equal(part[:count], of_few)
