"""Every way in which a trial ends, provoked; what a policy is shown; and all worlds step alike."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import suite
from eval.effects.slung_load import SlungLoad
from eval.judging.judge import JudgeOptions, Record
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds import scene_slots
from eval.worlds.trial import Rules, TrialSpec
from policies.spec import PolicySpec
from tests.support import reference as reference_world
from tests.support.courses import fly_on, straight
from tests.support.marks import more
from tests.support.pilots import Pursuit, Scripted, Steady, Watcher
from tests.support.reference import assert_alike, fly
from tests.support.vehicles import PLAIN, with_effects, with_lag
from tracks.families import make_track
from tracks.geometry.camera import Camera

VEHICLE = load_vehicle(Path(scene_slots.__file__).parent.parent / "vehicles" / "reference.toml")
WORLDS = ["mujoco", "reference"]
RULES = Rules()


@pytest.mark.parametrize("unfit", [object, scene_slots.SceneSlots.load, "a text"])
def test_what_has_not_the_methods_of_a_simulator_is_refused(unfit):
    with pytest.raises(ValueError, match="with the methods load, view, advance, collided_with"):
        suite.register_simulator("unfit", unfit)


def one(policy, track, world, rules=RULES):
    return fly_on(policy, track, vehicle=VEHICLE, world=world, slots=4, rules=rules)[0][0]


@pytest.mark.parametrize("world", WORLDS)
def test_a_flight_through_all_gates_is_finished(world):
    result = one(Pursuit(3.0), straight(), world)
    assert (result.ended_by, result.success, result.gates_passed) == ("finished", True, 2)
    assert (result.gates_8s, result.gates_035, result.collided_with) == (2, 2, None)
    # The centre has just crossed the last gate's plane, at the speed it has then.
    assert 0 <= result.pos_x - 4.0 < result.v_max * 0.002 + 1e-9
    assert 1.0 < result.v_mean < result.v_max < 3.5
    assert result.v_mean == pytest.approx(4.0 / result.time_s, rel=0.02)


@pytest.mark.parametrize("world", ["mujoco", more("reference")])
def test_contact_with_the_wall_or_the_ground_is_a_collision(world):
    result = one(Pursuit(3.0), straight((1.0, 4.0), wall_at=2.0), world)
    assert (result.ended_by, result.collided_with) == ("collision", "the wall")
    assert (result.success, result.gates_passed) == (False, 1)
    # The body's front reaches 0.064 m ahead, lower when pitched; the wall's face is at 1.95 m.
    assert 1.95 - 0.08 < result.pos_x < 1.95 - 0.03
    result = one(Steady((0.0, 0.0, -2.0)), straight(), world)
    assert (result.ended_by, result.collided_with) == ("collision", "ground")
    assert result.pos_z == pytest.approx(0.025, abs=0.01)
    # Fell 1.475 m at 2 m/s^2 less the file's vertical drag of 4 x 0.18 1/s (and a little of
    # 4 x 0.01 1/m), after a delay and a lag of 30 ms each.
    t = np.linspace(0, 3, 30001)
    fallen = 2 / 0.72 * (t - (1 - np.exp(-0.72 * t)) / 0.72)
    assert result.time_s == pytest.approx(t[np.searchsorted(fallen, 1.475)] + 0.06, rel=0.03)


@pytest.mark.extended
def test_a_load_on_a_line_is_the_trials_own():
    """It begins hanging in each slot's trial, whatever flew there before and flies beside it."""
    loaded = replace(VEHICLE, effects={**VEHICLE.effects, "slung_load": SlungLoad(0.2, 0.5)})
    how = {"workers": 1, "rules": Rules(time_limit_s=0.4)}

    def flown(vehicle, world, slots, seeds=(0, 1, 2)):
        how.update(slots=slots, seeds=seeds)
        found, _ = fly_on(Pursuit(2.5), straight(height=3.0), vehicle=vehicle, world=world, **how)
        return [(r.pos_x, r.pos_y, r.pos_z, r.v_max, r.gates_passed) for r in found]

    ours = flown(loaded, "mujoco", 2)
    assert ours == flown(loaded, "reference", 3)
    assert ours[:2] == flown(loaded, "mujoco", 1, (0, 1)), "alone"
    assert ours[0] == ours[1] == ours[2], "the same flight in a slot that is used again"
    without = flown(VEHICLE, "mujoco", 1, (0,))
    assert ours[0][2] < without[0][2] - 0.1, "nothing makes up for its weight"


@pytest.mark.parametrize("world", ["mujoco", more("reference")])
def test_a_gate_crossed_outside_its_opening_does_not_count(world):
    track = straight((1.0,))
    track.scene.gates.opening_g[:] *= 0.01  # 1 cm: the pursuit is not that exact
    result = one(Pursuit(3.0), track, world, Rules(time_limit_s=1.2))
    assert result.gates_passed == 0 and result.gates_035 == 1


def with_forces(world, change, monkeypatch):
    """Let `change` make another wrench of that which acts at a step."""
    module = {"mujoco": scene_slots, "reference": reference_world}[world]
    original = module.autopilot_step

    def step_of(autopilot, state, motion, action_b, gate_w, step, noise=None):
        state, wrench = original(autopilot, state, motion, action_b, gate_w, step, noise)
        return state, change(motion, gate_w, step, wrench)

    monkeypatch.setattr(module, "autopilot_step", step_of)


@pytest.mark.parametrize("world", ["mujoco", more("reference")])
def test_diverged_ends_that_trial_only(world, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo would leave its log here

    def broken(motion, gate_w, step, wrench):
        wrench.force_b[(motion.pos_w[:, 0] > 0.3) & (gate_w[:, 0] > 1.0)] = np.nan
        return wrench

    tracks = straight((0.4, 0.8), name="well"), straight((1.2, 1.6), name="ill")
    how = {"vehicle": VEHICLE, "world": world, "slots": 4}
    (well, sound), _ = fly_on(Pursuit(3.0), *tracks, **how)
    with_forces(world, broken, monkeypatch)
    (same, ill), _ = fly_on(Pursuit(3.0), *tracks, **how)
    assert same == well and sound.ended_by == "finished"
    assert (ill.ended_by, ill.success) == ("diverged", False)
    assert 0.3 < ill.pos_x < 0.32 and all(map(math.isfinite, ill[10:16]))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("world", WORLDS)
def test_state_beyond_any_flight_is_diverged(world, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)

    def kicked(motion, gate_w, step, wrench):
        return wrench._replace(force_b=np.where(step[:, None] == 7, 1e5, wrench.force_b))

    with_forces(world, kicked, monkeypatch)
    result = one(Steady(), straight(), world, Rules(speed_limit=100.0))
    assert (result.ended_by, result.time_s) == ("diverged", pytest.approx(8 * 0.002))
    assert all(map(math.isfinite, result[10:16])) and list(tmp_path.iterdir()) == []


DISTANCES = (1.0, 2.5, 4.5)


def shown(world, trial, seconds, **more):
    policy = Watcher(Pursuit(spec=PolicySpec(camera=Camera(width=20, height=20), **more)))
    options = JudgeOptions(slots=1, rules=Rules(time_limit_s=seconds))
    tracks = {"straight": straight(DISTANCES)}
    fly(policy, [trial], VEHICLE, world, options, tracks=tracks)
    return np.array([state[0] for state, _ in policy.given])


in_every_world = pytest.mark.parametrize(
    "world", ["mujoco", *(more(w) for w in ("reference", "mjx"))]
)


@in_every_world
def test_the_second_gate_and_the_direction_are_those_of_a_line_of_gates(world):
    """Level gates on a line: centres differ by the stretch, and the direction is along the line."""
    states = shown(world, TrialSpec("straight", 0, 0), 3.0, second_gate=True, gate_axis=True)
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
    along = stretch[ahead, None] * axis[ahead]
    np.testing.assert_allclose((second - gate)[ahead], along, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(axis, axis=-1), 1.0, atol=1e-5)


@in_every_world
def test_the_direction_of_the_gate_after_is_that_gates(world):
    """Whatever the body's axes are, both directions make the same angle in them."""
    state = shown(world, TrialSpec("zigzag", 9, 1), 0.1, gate_axis=True, second_axis=True)[0]
    axis, after = make_track("zigzag", 9, 1).scene.gates.rot_w[:2, :, 0]
    assert axis @ after < 0.95
    assert state[12:15] @ state[15:] == pytest.approx(axis @ after, abs=1e-5)


PARITY = with_lag(
    with_effects(quadratic_drag=((0.02, 0.02, 0.06),), command_delay=(0.02,), thrust_scale=(1.05,)),
    0.03,
)
"""What every world can fly as its file says. (Drag and inflow of rotors would act at RotorPy's hubs
by the hubs' own airspeed: a difference of models, in `rotorpy_vehicle.differences`.)"""
SECOND = np.arange(30) / 30
WAVES = (6 * np.sin(2 * np.pi * SECOND), 8 * np.cos(3 * np.pi * SECOND),
         5 * np.sin(2 * np.pi * SECOND + 1))  # fmt: skip
MOTIONS = {
    "hover": (np.zeros((1, 3)), (100.0, 0.0)),
    "fall": (np.array([[0.0, 0.0, -9.81]]), (100.0, 0.0)),
    "spin": (np.zeros((1, 3)), (-100.0, 1.0)),
    "manoeuvre": (np.stack(WAVES, axis=-1), (3.0, 40.0)),
}
"""Actions [m/s^2], and where the gate is that the heading follows [m]."""
STEP_S = 0.002
EULER_M, EULER_SPEED, EULER_QUAT = 0.005, 0.0075, 0.006
"""MuJoCo's Euler steps are of order 1: after 0.5 s of up to 1 g they are up to dt/2 g 0.5 s =
4.9 mm from continuous motion; speed and attitude go by the same step, through the loops. RotorPy's
steps are of order 4, and nowhere near that."""


def moved(world, motion, frequency=1 / STEP_S, vehicle=PARITY, seconds=1.0):
    """Return what `motion` in `world` comes to: the result, and the flight if any."""
    actions, (x, y) = MOTIONS[motion]
    track, record = straight((x,), height=40.0), None if world == "reference" else Record()
    track.scene.gates.center_w[0, 1] = y
    faster = replace(vehicle, controller=replace(vehicle.controller, frequency=frequency))
    (result,), (flight,) = fly_on(
        Scripted(actions), track, vehicle=faster, world=world, record=record, slots=1,
        rules=Rules(time_limit_s=seconds),
    )  # fmt: skip
    assert result.ended_by == "timeout"
    return result, flight


each_motion = pytest.mark.parametrize(
    "motion", ["manoeuvre", *(more(m) for m in list(MOTIONS)[:3])]
)
"""The manoeuvre has everything; the others at full size."""


@cache
def by_mujoco(motion):
    return moved("mujoco", motion)


@each_motion
def test_the_reference_steps_as_mujoco_does(motion):
    assert_alike(moved("reference", motion)[0][7:16], by_mujoco(motion)[0][7:16])


@pytest.mark.slow
@pytest.mark.parametrize("motion", MOTIONS)
def test_mjx_steps_as_mujoco_does(motion):
    """But for single precision: of positions of up to 40 m, over 500 steps."""
    flight, single = by_mujoco(motion)[1], moved("mjx", motion)[1]
    assert np.abs(single.pos_w - flight.pos_w).max() < 5e-5
    assert np.abs(single.quat_wxyz - flight.quat_wxyz).max() < 1e-5


@each_motion
def test_rotorpy_steps_as_mujoco_does_but_for_the_length_of_mujocos_steps(motion):
    (_, ours), (_, theirs) = by_mujoco(motion), moved("rotorpy", motion, seconds=0.3)
    rows = len(theirs.time_s)
    np.testing.assert_allclose(theirs.time_s, ours.time_s[:rows], atol=1e-9)
    assert rows == 31 and np.abs(ours.pos_w[:rows] - theirs.pos_w).max() < EULER_M
    assert np.abs(ours.vel_w[:rows] - theirs.vel_w).max() < EULER_SPEED
    assert np.abs(ours.quat_wxyz[:rows] - theirs.quat_wxyz).max() < EULER_QUAT


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["fall", "spin", "manoeuvre"])
def test_what_differs_from_rotorpy_halves_with_the_step(motion):
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


@pytest.mark.extended
def test_rotorpy_falls_as_continuous_equations_say():
    """Rotors that run down from a hover with lag tau push with g exp(-2 t / tau)."""
    tau, end = 0.03, 0.3
    _, flight = moved("rotorpy", "fall", vehicle=with_lag(PLAIN, tau), seconds=end)
    gone = tau / 2 * (1 - math.exp(-2 * end / tau))
    assert flight.vel_w[-1, 2] == pytest.approx(9.81 * (gone - end), abs=1e-4)
    fallen = 9.81 * (tau / 2 * (end - gone) - end**2 / 2)
    assert flight.pos_w[-1, 2] == pytest.approx(40.0 + fallen, abs=1e-4)
