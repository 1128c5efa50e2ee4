"""Every way in which a trial ends, provoked; what a policy is shown; and all worlds step alike."""

import math
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from eval.effects.slung_load import SlungLoad
from eval.judging.judge import JudgeOptions, Record, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds import WORLDS as TABLE
from eval.worlds import mujoco as mujoco_world
from eval.worlds import reference as reference_world
from eval.worlds.scene_slots import TO_CONTACTS, SceneSlots
from eval.worlds.trial import Rules, TrialSpec
from policies.spec import PolicySpec
from tests.support.courses import straight
from tests.support.pilots import Pursuit, Scripted, Steady
from tests.support.vehicles import PLAIN, with_effects, with_lag
from tracks.families import make_track
from tracks.geometry.camera import Camera

VEHICLE = load_vehicle(Path(mujoco_world.__file__).parent.parent / "vehicles" / "reference.toml")

WORLDS = ["mujoco", "reference"]

RULES = Rules()


def one(policy, track, world, rules=RULES, seed=0):
    options = JudgeOptions(slots=4, rules=rules)
    trial = TrialSpec(track.family, 0, seed)
    (result,) = fly(policy, [trial], VEHICLE, world, options, tracks={track.family: track})
    return result


@pytest.mark.parametrize("world", WORLDS)
def test_finished(world):
    result = one(Pursuit(3.0), straight(), world)
    assert (result.ended_by, result.success, result.gates_passed) == ("finished", True, 2)
    assert (result.gates_8s, result.gates_035, result.collided_with) == (2, 2, None)
    # The centre has just crossed the last gate's plane, at the speed it has then.
    assert 0 <= result.pos_x - 4.0 < result.v_max * 0.002 + 1e-9
    assert 1.0 < result.v_mean < result.v_max < 3.5
    assert result.v_mean == pytest.approx(4.0 / result.time_s, rel=0.02)


@pytest.mark.parametrize("world", WORLDS)
def test_collision_with_the_wall(world):
    result = one(Pursuit(3.0), straight(wall_at=3.0), world)
    assert (result.ended_by, result.collided_with) == ("collision", "the wall")
    assert (result.success, result.gates_passed) == (False, 1)
    # The body's front reaches 0.064 m ahead, lower when pitched; the wall's face is at 2.95 m.
    assert 2.95 - 0.08 < result.pos_x < 2.95 - 0.03


@pytest.mark.parametrize("world", WORLDS)
def test_collision_with_the_ground(world):
    result = one(Steady((0.0, 0.0, -2.0)), straight(), world)
    assert (result.ended_by, result.collided_with) == ("collision", "ground")
    assert result.pos_z == pytest.approx(0.025, abs=0.01)
    # Fell 1.475 m at 2 m/s^2 less the file's vertical drag of 4 x 0.18 1/s (and a little of
    # 4 x 0.01 1/m), after a delay and a lag of 30 ms each.
    t = np.linspace(0, 3, 30001)
    fallen = 2 / 0.72 * (t - (1 - np.exp(-0.72 * t)) / 0.72)
    assert result.time_s == pytest.approx(t[np.searchsorted(fallen, 1.475)] + 0.06, rel=0.03)


def test_a_load_on_a_line_is_the_trials_own():
    """It begins hanging in each slot's trial, whatever flew there before and flies beside it."""
    loaded = replace(VEHICLE, effects={**VEHICLE.effects, "slung_load": SlungLoad(0.1, 0.5)})
    track, rules = straight(height=3.0), Rules(time_limit_s=0.8)
    trials = [TrialSpec(track.family, 0, seed) for seed in range(3)]

    def flown(vehicle, world, slots):
        options = JudgeOptions(slots=slots, workers=1, rules=rules)
        tracks = {track.family: track}
        found = fly(Pursuit(2.5), trials, vehicle, world, options, tracks=tracks)
        return [(r.pos_x, r.pos_y, r.pos_z, r.v_max, r.gates_passed) for r in found]

    ours = flown(loaded, "mujoco", 2)
    assert ours == flown(loaded, "mujoco", 1) == flown(loaded, "reference", 3)
    assert ours[0] == ours[1] == ours[2], "the same flight in a slot that is used again"
    without = flown(VEHICLE, "mujoco", 3)
    assert ours[0][2] < without[0][2] - 0.1, "nothing makes up for its weight"


@pytest.mark.parametrize("world", WORLDS)
def test_tipped(world):
    result = one(Steady((0.0, 20.0, -15.0)), straight(height=30.0), world)
    assert (result.ended_by, result.success) == ("tipped", False)


@pytest.mark.parametrize("world", WORLDS)
def test_timeout(world):
    result = one(Steady(), straight(), world, Rules(time_limit_s=1.0))
    assert (result.ended_by, result.time_s) == ("timeout", pytest.approx(1.0, abs=1e-12))
    # Hovering: nothing moves but for what the delay of the loops lets through.
    assert abs(result.pos_z - 1.5) < 0.02 and result.v_max < 0.1


@pytest.mark.parametrize("world", WORLDS)
def test_crossing_outside_the_opening_does_not_count(world):
    track = straight((1.0,))
    track.scene.gates.opening_g[:] *= 0.01  # 1 cm: the pursuit is not that exact
    result = one(Pursuit(3.0), track, world, Rules(time_limit_s=2.0))
    assert result.gates_passed == 0 and result.gates_035 == 1


@pytest.mark.parametrize("world", WORLDS)
def test_diverged_ends_that_trial_only(world, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo would leave its log here
    module = {"mujoco": mujoco_world, "reference": reference_world}[world]
    original = module.autopilot_step

    def broken(autopilot, state, motion, action_b, gate_w, step, noise=None):
        state, wrench = original(autopilot, state, motion, action_b, gate_w, step, noise)
        ill = (motion.pos_w[:, 0] > 0.5) & (gate_w[:, 0] > 2.0)
        wrench.force_b[ill] = np.nan
        return state, wrench

    well, ill = straight((0.8, 1.6), name="well"), straight((2.4, 3.2), name="ill")
    trials = [TrialSpec("well", 0, 0), TrialSpec("ill", 0, 0), TrialSpec("well", 0, 1)]
    tracks, options = {"well": well, "ill": ill}, JudgeOptions(slots=4)
    before = fly(Pursuit(3.0), trials, VEHICLE, world, options, tracks=tracks)
    monkeypatch.setattr(module, "autopilot_step", broken)
    after = fly(Pursuit(3.0), trials, VEHICLE, world, options, tracks=tracks)
    assert (after[0], after[2]) == (before[0], before[2])
    assert before[1].ended_by == "finished"
    assert (after[1].ended_by, after[1].success) == ("diverged", False)
    assert 0.5 < after[1].pos_x < 0.6 and all(map(math.isfinite, after[1][10:16]))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("world", WORLDS)
def test_state_beyond_any_flight_is_diverged(world, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    module = {"mujoco": mujoco_world, "reference": reference_world}[world]
    original = module.autopilot_step

    def kicked(autopilot, state, motion, action_b, gate_w, step, noise=None):
        state, wrench = original(autopilot, state, motion, action_b, gate_w, step, noise)
        return state, wrench._replace(force_b=np.where(step[:, None] == 7, 1e5, wrench.force_b))

    monkeypatch.setattr(module, "autopilot_step", kicked)
    result = one(Steady(), straight(), world, Rules(speed_limit=100.0))
    assert (result.ended_by, result.time_s) == ("diverged", pytest.approx(8 * 0.002))
    assert all(map(math.isfinite, result[10:16])) and list(tmp_path.iterdir()) == []


def test_collision_at_the_start():
    result = one(Pursuit(), straight(wall_at=0.0), "mujoco")
    assert (result.ended_by, result.time_s, result.collided_with) == ("collision", 0.0, "the wall")
    assert result.v_max == 0.0


DISTANCES = (1.0, 2.5, 4.5)


@dataclass
class Witness(Pursuit):
    """A pursuit that keeps what it was shown."""

    seen: list = field(default_factory=list)

    def act(self, hidden, state, image, fresh):
        self.seen.append(state[0].copy())
        return super().act(hidden, state, image, fresh)


def shown(world, **more):
    camera = Camera(width=20, height=20)
    policy = Witness(spec=replace(PolicySpec(camera=camera), **more))
    options = JudgeOptions(slots=1, rules=Rules(time_limit_s=3.0))
    tracks = {"straight": straight(DISTANCES)}
    result = fly(policy, [TrialSpec("straight", 0, 0)], VEHICLE, world, options, tracks=tracks)[0]
    assert result.ended_by == "finished"
    return np.array(policy.seen)


@pytest.mark.parametrize(
    "world", ["mujoco", "reference", pytest.param("mjx", marks=pytest.mark.slow)]
)
def test_the_second_gate_and_the_direction_are_those_of_a_line_of_gates(world):
    """Level gates on a line: centres differ by the stretch, and the direction is along the line."""
    states = shown(world, second_gate=True, gate_axis=True)
    assert states.shape[1] == 18
    gate, second, axis = states[:, 6:9], states[:, 12:15], states[:, 15:]
    distance = np.linalg.norm(gate, axis=-1)
    stretch = np.linalg.norm(second - gate, axis=-1)
    number = np.cumsum(np.diff(distance, prepend=9.0) > 0.5)
    expected = np.array([*np.diff(DISTANCES), 0.0])
    assert set(number) == {0, 1, 2}
    np.testing.assert_allclose(stretch, expected[number], atol=1e-4)
    ahead = number < 2
    assert np.all(second[ahead, 0] > gate[ahead, 0] + 0.5)
    # From gate to gate is the direction itself, in whatever axes.
    np.testing.assert_allclose(
        (second - gate)[ahead], stretch[ahead, None] * axis[ahead], atol=1e-4
    )
    np.testing.assert_allclose(np.linalg.norm(axis, axis=-1), 1.0, atol=1e-5)


@pytest.mark.parametrize(
    "world", ["mujoco", "reference", pytest.param("mjx", marks=pytest.mark.slow)]
)
def test_the_direction_of_the_gate_after_is_that_gates(world):
    """Whatever the body's axes are, both directions make the same angle in them."""
    camera = Camera(width=20, height=20)
    policy = Witness(spec=PolicySpec(camera=camera, gate_axis=True, second_axis=True))
    options = JudgeOptions(slots=1, rules=Rules(time_limit_s=0.1))
    fly(policy, [TrialSpec("zigzag", 9, 1)], VEHICLE, world, options)
    axis, after = make_track("zigzag", 9, 1).scene.gates.rot_w[:2, :, 0]
    assert axis @ after < 0.95
    assert policy.seen[0][12:15] @ policy.seen[0][15:] == pytest.approx(axis @ after, abs=1e-5)


class Drifting(SceneSlots):
    """A world of one's own: bodies drift along x at 2 m/s, whatever the policy wants."""

    name = "drifting"

    def _control(self, motion, action_b, gate_w, step, noise):
        return self._loops, None

    def _move(self, flying, motion, push):
        self._qpos[flying, 0] += 2.0 * self.dt
        self._qvel[flying, 0] = 2.0
        self._batch.forward(np.flatnonzero(flying).astype(np.int32), stage=TO_CONTACTS)
        return np.zeros_like(flying)


def test_a_world_of_ones_own_says_how_bodies_move_and_nothing_else(monkeypatch):
    monkeypatch.setitem(TABLE._entries, "drifting", Drifting)
    result = one(Steady(), straight(wall_at=3.0), "drifting")
    assert (result.collided_with, result.gates_passed, result.world) == ("the wall", 1, "drifting")
    assert result.pos_x == pytest.approx(2.95 - 0.064, abs=0.005) and result.v_max == 2.0


PARITY = with_lag(
    with_effects(quadratic_drag=((0.02, 0.02, 0.06),), command_delay=(0.02,), thrust_scale=(1.05,)),
    0.03,
)
"""What every world can fly as its file says. (Drag and inflow of rotors would act at RotorPy's hubs
by the hubs' own airspeed: a difference of models, in `rotorpy_vehicle.differences`.)"""

SECOND = np.arange(30) / 30

TURNS = np.stack(
    [
        6 * np.sin(2 * np.pi * SECOND),
        8 * np.cos(3 * np.pi * SECOND),
        5 * np.sin(2 * np.pi * SECOND + 1),
    ],
    axis=-1,
)

MOTIONS = {
    "hover": (np.zeros((1, 3)), (100.0, 0.0)),
    "fall": (np.array([[0.0, 0.0, -9.81]]), (100.0, 0.0)),
    "spin": (np.zeros((1, 3)), (-100.0, 1.0)),
    "manoeuvre": (TURNS, (3.0, 40.0)),
}
"""Actions [m/s^2], and where the gate is that the heading follows [m]."""

STEP_S = 0.002

EULER_M, EULER_SPEED, EULER_QUAT = 0.010, 0.015, 0.012
"""MuJoCo's Euler steps are of order 1: after a second of up to 1 g they are up to dt/2 g 1 s =
9.8 mm from continuous motion; speed and attitude go by the same step, through the loops. RotorPy's
steps are of order 4, and nowhere near that."""

FLOAT32_M = 5e-5
"""mjx against mujoco: rounding to single precision at positions of up to 40 m, over 500 steps."""


def moved(world, motion, frequency=1 / STEP_S, vehicle=PARITY, seconds=1.0):
    """Return what `motion` in `world` comes to: the result, and the flight if any."""
    actions, (x, y) = MOTIONS[motion]
    track = straight((x,), height=40.0)
    track.scene.gates.center_w[0, 1] = y
    faster = replace(vehicle, controller=replace(vehicle.controller, frequency=frequency))
    flights = []
    (result,) = fly(
        Scripted(actions),
        [TrialSpec("straight", 0, 0)],
        faster,
        world,
        JudgeOptions(slots=1, rules=Rules(time_limit_s=seconds)),
        lambda _, flight: flights.append(flight),
        None if world == "reference" else Record(),
        {"straight": track},
    )
    assert result.ended_by == "timeout"
    return result, flights[0]


def each_of(motions):
    """All but the manoeuvre, which has everything, at full size."""
    marks = {"manoeuvre": ()}
    params = [pytest.param(m, marks=marks.get(m, pytest.mark.slow)) for m in motions]
    return pytest.mark.parametrize("motion", params)


@cache
def by_mujoco(motion):
    return moved("mujoco", motion)


@each_of(MOTIONS)
def test_the_reference_steps_as_mujoco_does(motion):
    assert moved("reference", motion)[0][7:16] == by_mujoco(motion)[0][7:16]


@pytest.mark.slow
@pytest.mark.parametrize("motion", MOTIONS)
def test_mjx_steps_as_mujoco_does(motion):
    """On trials of the judge `test_mjx.py` compares them at every run."""
    flight, single = by_mujoco(motion)[1], moved("mjx", motion)[1]
    assert np.abs(single.pos_w - flight.pos_w).max() < FLOAT32_M
    assert np.abs(single.quat_wxyz - flight.quat_wxyz).max() < 1e-5


@pytest.fixture
def rotorpy():
    pytest.importorskip("rotorpy")
    pytest.importorskip("torchdiffeq")


@each_of(MOTIONS)
def test_rotorpy_steps_as_mujoco_does_but_for_the_length_of_mujocos_steps(motion, rotorpy):
    (_, ours), (_, theirs) = by_mujoco(motion), moved("rotorpy", motion)
    assert np.abs(ours.pos_w - theirs.pos_w).max() < EULER_M
    assert np.abs(ours.vel_w - theirs.vel_w).max() < EULER_SPEED
    assert np.abs(ours.quat_wxyz - theirs.quat_wxyz).max() < EULER_QUAT


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["fall", "spin", "manoeuvre"])
def test_what_differs_from_rotorpy_halves_with_the_step(motion, rotorpy):
    """Nothing else does: a difference of models would stay."""

    def apart(frequency):
        (_, ours), (_, theirs) = (
            moved(world, motion, frequency) for world in ("mujoco", "rotorpy")
        )
        return np.array([
            np.linalg.norm(ours.pos_w[-1] - theirs.pos_w[-1]),
            np.linalg.norm(ours.quat_wxyz[-1] - theirs.quat_wxyz[-1]) + 1e-9,
        ])  # fmt: skip

    position, attitude = apart(500.0) / apart(1000.0)
    assert 1.8 < position < 2.2
    assert 1.8 < attitude < 2.3 or motion == "fall"


def test_rotorpy_falls_as_continuous_equations_say(rotorpy):
    """Rotors that run down from a hover with lag tau push with g exp(-2 t / tau)."""
    tau, end = 0.03, 0.5
    _, flight = moved("rotorpy", "fall", vehicle=with_lag(PLAIN, tau), seconds=end)
    gone = tau / 2 * (1 - math.exp(-2 * end / tau))
    assert flight.vel_w[-1, 2] == pytest.approx(9.81 * (gone - end), abs=1e-4)
    fallen = 9.81 * (tau / 2 * (end - gone) - end**2 / 2)
    assert flight.pos_w[-1, 2] == pytest.approx(40.0 + fallen, abs=1e-4)
