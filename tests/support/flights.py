"""A small track and a smooth flight through its gates, for tests of logs and views."""

from functools import cache

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from eval.logs.flight import Flight
from tests.support.judged_cells import result
from tracks.geometry.gates import frame_boxes, square_gates
from tracks.geometry.scene import Boxes, Rods, Scene, Spheres
from tracks.track import Track

GRAVITY = np.array([0.0, 0.0, 9.81])
RATE_HZ = 100.0
POLICY_EVERY = 3
WAIT_S = 0.004
"""Time from a decision to the row that flies its action."""


def small_track(gate_count=4, seed=5):
    """A bent line of square gates with one obstacle of each kind beside it."""
    rng = np.random.default_rng(seed)
    x = 4.0 * np.arange(gate_count)
    center = np.stack([x, rng.uniform(-1.5, 1.5, gate_count), rng.uniform(1, 2, gate_count)], 1)
    size = np.ones(gate_count)
    gates = square_gates(center, rng.uniform(-0.4, 0.4, gate_count), size, 0.2 * size, 0.05 * size)
    bars = frame_boxes(gates)
    plate = Rotation.from_euler("xyz", [0.4, 0.3, 0.5]).as_matrix()
    boxes = Boxes(
        np.concatenate([bars.center_w, [[2.0, 2.5, 1.2]]]),
        np.concatenate([bars.rot_w, plate[None]]),
        np.concatenate([bars.half_size, [[0.4, 0.3, 0.03]]]),
    )
    upright, tilted = np.array([[0.0, 0.0, 1.0]]), np.array([[0.6, 0.0, 0.8]])
    scene = Scene(
        gates,
        boxes,
        Rods(np.array([[6.0, -2.5, 1.0]]), upright, np.array([0.3]), np.array([1.0])),
        Rods(np.array([[9.0, 2.5, 1.0]]), tilted, np.array([0.2]), np.array([0.4])),
        Spheres(np.array([[10.0, -2.0, 0.25]]), np.array([0.25])),
        np.zeros((0, 3, 3)),
    )
    names = tuple(f"gate {g} frame" for g in range(gate_count) for _ in range(4))
    names += ("plate 0", "pillar 0", "capsule 0", "sphere 0")
    start = np.array([-2.5, center[0, 1], 1.3])
    return Track("zigzag", 3, seed, 0.35, scene, start, 0.0, names)


def smooth_flight(track, speed=4.0, duration_s=None, depth=True):
    """A flight along a spline through the gates, with attitude, rates and thrust to match."""
    gates = track.scene.gates
    ahead = 0.5 * gates.rot_w[..., 0]
    legs = np.stack([gates.center_w - ahead, gates.center_w, gates.center_w + ahead], 1)
    points = np.concatenate([track.start_pos_w[None], legs.reshape(-1, 3)])
    knots = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    spline = CubicSpline(knots / speed, points)
    end = knots[-1] / speed if duration_s is None else duration_s
    time = np.arange(0, end, 1 / RATE_HZ)
    pos, vel, acc = spline(time), spline(time, 1), spline(time, 2)
    force = acc + GRAVITY
    thrust = np.linalg.norm(force, axis=1)
    up = force / thrust[:, None]
    left = np.cross(up, vel)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    rot = np.stack([np.cross(left, up), left, up], axis=-1)
    quat_wxyz = Rotation.from_matrix(rot).as_quat(scalar_first=True)
    turn = Rotation.from_matrix(np.swapaxes(rot[:-1], 1, 2) @ rot[1:]).as_rotvec() * RATE_HZ
    rate = np.concatenate([turn, turn[-1:]])
    step = np.arange(len(time)) % POLICY_EVERY == 0
    passed = (time[:, None] >= knots[2::3] / speed).sum(1)
    frames = None
    if depth:
        frames = np.tile(np.linspace(10, 1, 24)[:, None], (int(step.sum()), 1, 32))
        frames = (frames + 0.01 * np.arange(len(frames))[:, None, None]).astype(np.float32)
    return Flight(
        time_s=time,
        pos_w=pos,
        quat_wxyz=quat_wxyz,
        vel_w=vel,
        rate_b=rate,
        thrust_cmd=thrust,
        rate_cmd_b=rate,
        rotor_speed=np.sqrt(0.75 * thrust / 4 / 1.6e-6)[:, None] * np.ones(4),
        action_b=np.einsum("tij,ti->tj", rot, acc),
        policy_step=step,
        gate=passed.astype(np.int32),
        depth_m=frames,
        depth_time_s=np.maximum(time[step] - WAIT_S, 0) if depth else None,
        about={"track": track.family, "difficulty": track.level, "seed": track.seed},
    )


def result_of(track, flight, ended_by):
    """The row of trials.parquet that such a flight has."""
    speed, gates = np.linalg.norm(flight.vel_w, axis=1), int(flight.gate[-1])
    won, hit = ended_by == "finished", ended_by == "collision"
    row = result(track.seed, won, "spline", track.level)
    x, y, z = flight.pos_w[-1].tolist()
    return row._replace(
        track=track.family, world="none", ended_by=ended_by, gates_passed=gates, gates_8s=gates,
        gates_035=gates, collided_with="pillar 0" if hit else None, pos_x=x, pos_y=y, pos_z=z,
        time_s=float(flight.time_s[-1]), v_max=float(speed.max()), v_mean=float(speed.mean()),
    )  # fmt: skip


@cache
def rollout(ended_by="finished", duration_s=None, depth=True):
    """A small track, a flight on it and its result, made once."""
    track = small_track()
    flight = smooth_flight(track, duration_s=duration_s, depth=depth)
    return track, flight, result_of(track, flight, ended_by)


def small_log():
    t = np.array([0.0, 0.01, 0.02, 0.03, 0.04])
    half = 0.5 * t  # turns about z at 1 rad/s
    quat = np.stack([np.cos(half), 0 * t, 0 * t, np.sin(half)], axis=-1)
    quat[3:] *= -1.0  # the same attitude, told with the other sign
    steady_rate = np.tile([0.0, 0.0, 1.0], (5, 1))
    return {
        "time_s": t,
        "pos_w": np.stack([3.0 * t, 0 * t, 1 + 0 * t], axis=-1),
        "vel_w": np.stack([3.0 + 2.0 * t, 0 * t, 0 * t], axis=-1),
        "quat_wxyz": quat,
        "rate_b": steady_rate,
        "acc_b": np.tile([0.0, 0.0, 9.81], (5, 1)),
        "thrust_cmd": 10.0 + t,
    }
