"""One trial (a flight along a track) as a loop of MuJoCo steps, to compare the simulators with.

Both use the same vehicle model, but this one counts gates and ends a trial by separate code.
"""

from __future__ import annotations

import sys

import mujoco
import numpy as np
import pytest

from eval.judging import judge
from eval.judging.guard import ActionLimits, Guarded, call_policy, first_action, limits_of
from eval.judging.policy_checks.in_flight import Outputs
from eval.judging.sensors import Sensors
from eval.quadrotor.autopilot import autopilot_step, make_autopilot, start_autopilot
from eval.quadrotor.plant import Motion, uses_noise
from eval.sensors import view_models
from eval.sensors.sensors_file import PERFECT, SensorSet
from eval.vehicles.vehicle import Vehicle
from eval.worlds.engine import DepthCamera, compile_model, contact_name, motion_of, start_state
from eval.worlds.slots import GustDraws, layout_of
from eval.worlds.trial import SHORT_WINDOW_S, Rules, TrialResult, TrialSpec, track_of
from policies.observation import observe, view_of
from policies.policy import Policy
from tracks.geometry.crossing import crossing, is_near
from tracks.geometry.rotation import to_world
from tracks.geometry.scene import Gates
from tracks.track import Track

REFERENCE = "reference"
"""Name of this simulator, for `fly`."""


def fly(policy, trials, vehicle, world="mujoco", options=None, on_result=None, record=None,
        tracks=None):  # fmt: skip
    """Fly trials as `eval.judging.judge.fly` does; in the world `REFERENCE` one after the other."""
    if world != REFERENCE:
        return judge.fly(policy, trials, vehicle, world, options, on_result, record, tracks)
    options, results = options or judge.JudgeOptions(), []
    for trial in trials:
        track = track_of(tracks or {}, trial)
        how = (options.rules, options.limits, options.slots, options.sensors)
        results.append(fly_trial(policy, trial, track, vehicle, *how))
        if on_result:
            on_result(results[-1], None)
    return results


def fly_trial(
    policy: Policy,
    trial: TrialSpec,
    track: Track,
    vehicle: Vehicle,
    rules: Rules | None = None,
    limits: ActionLimits | None = None,
    rows: int = 64,
    sensor_set: SensorSet = PERFECT,
) -> TrialResult:
    """Fly one trial as a plain loop, the slow and simple check of the other simulators.

    Rules and limits have defaults. The policy's inputs have `rows` rows, all zero but the first. It
    should be the number of the batched simulators, because the output of some policies depends on
    it.

    Returns:
        The outcome of the trial.

    It has neither delayed nor filtered observations.
    """
    assert not sensor_set.has_delay and not sensor_set.estimator
    rules, limits = rules or Rules(), limits or ActionLimits()
    autopilot = make_autopilot(vehicle, policy.spec.action)
    dt, spec = autopilot.dt, policy.spec
    model = compile_model(track, vehicle, dt, layout_of([track]).solids)
    data = mujoco.MjData(model)
    data.qpos[:] = start_state(track)
    mujoco.mj_step1(model, data)  # contacts of the first state
    gates, count = track.scene.gates, len(track.scene.gates.center_w)
    gusts = GustDraws(trial) if uses_noise(autopilot.plant) else None
    camera, policy_memory = DepthCamera(spec.camera), policy.start(rows)
    loops = start_autopilot(autopilot, motion_of(data), gusts and gusts.at(0, 1))
    sensors = None
    if view_models(sensor_set.models):
        sensors = Sensors(sensor_set, 1, spec.rate_hz, spec.camera)
        sensors.start(0, trial)
    limits = limits_of(limits, spec.action, vehicle)
    action_b = first_action(spec.action, vehicle)[None]
    outputs, decisions = Outputs(1, spec.action), 0
    passed = passed_8s = passed_035 = 0
    speeds: list[float] = []
    before_w = data.qpos[:3].copy()
    ended_by, collided_with, step = None, None, 0

    while True:
        # Check the state after the last step, by the rules for the end and the score of a trial.
        motion = motion_of(data)
        pos_w = motion.pos_w[0]
        if not _is_flight(motion, rules):
            ended_by = "diverged"
            break
        speeds.append(float(np.sqrt((motion.vel_w[0] ** 2).sum())))
        if data.ncon > 0:
            ended_by, collided_with = "collision", contact_name(model, data)
        else:
            gate = (gates.center_w[passed], gates.rot_w[passed], gates.opening_g[passed])
            passed += bool(crossing(*gate, before_w, pos_w)[0])
            if passed_035 < count:
                near_w = gates.center_w[passed_035]
                passed_035 += bool(is_near(near_w, pos_w))
            if passed == count:
                ended_by = "finished"
            elif motion.rot_w[0, 2, 2] < 0:
                ended_by = "tipped"
            elif step >= round(rules.time_limit_s / dt):
                ended_by = "timeout"
        if step <= round(SHORT_WINDOW_S / dt):
            passed_8s = passed
        before_w = pos_w
        if ended_by is not None:
            break

        # Run the policy at its rate.
        gate_w = gates.center_w[None, passed]
        if step == np.rint(decisions * (1 / (spec.rate_hz * dt))):
            depth_m = camera.image(model, data, pos_w, motion.rot_w[0])
            numbers = (passed, min(passed + 1, count - 1))
            next_gate, second_gate = (Gates(*(f[[number]] for f in gates)) for number in numbers)
            view = view_of(
                motion.pos_w, motion.rot_w, motion.vel_w, next_gate, second_gate, depth_m[None]
            )
            if sensors:
                view = view._replace(gate_number=np.array([passed]))
                view = sensors.see(view, np.array([decisions == 0]), np.array([True]))
            state, image = observe(spec, view, action_b)
            is_first = np.full(rows, decisions == 0)
            padded_state, padded_image = _padded(state, rows), _padded(image, rows)
            last_b = np.repeat(action_b, rows, 0)
            guarded, policy_memory = call_policy(
                limits, policy, policy_memory, padded_state, padded_image, is_first, last_b
            )
            action_b = guarded.action_b[:1]
            outputs.add(Guarded._make(part[:1] for part in guarded), state.astype(np.float32))
            decisions += 1
            if guarded.late[0]:
                ended_by = "timeout"
                break

        # Fly one step.
        gust_draw = gusts and gusts.at(step + 1, 1)
        loops, wrench = autopilot_step(
            autopilot, loops, motion, action_b, gate_w, np.array([step]), gust_draw
        )
        step += 1
        if not (np.abs([wrench.force_b, wrench.torque_b]) <= rules.wrench_limit).all():
            ended_by = "diverged"
            break
        data.qfrc_applied[:3] = to_world(motion.rot_w, wrench.force_b)[0]
        data.qfrc_applied[3:] = wrench.torque_b[0]
        mujoco.mj_step2(model, data)
        mujoco.mj_step1(model, data)

    # v_max is the largest speed before any contact.
    contact_free = speeds[:-1] if ended_by == "collision" else speeds
    return TrialResult(
        *trial,
        policy=policy.name,
        vehicle=vehicle.name,
        world=REFERENCE,
        success=ended_by == "finished",
        gates_passed=passed,
        ended_by=ended_by,
        collided_with=collided_with,
        pos_x=float(before_w[0]),
        pos_y=float(before_w[1]),
        pos_z=float(before_w[2]),
        time_s=step * dt,
        v_max=max(contact_free, default=0.0),
        v_mean=sum(speeds) / max(len(speeds), 1),
        gates_8s=passed_8s,
        gates_035=passed_035,
        **outputs.columns(0),
    )


def _is_flight(motion: Motion, rules: Rules) -> bool:
    """Return whether the state is finite and no faster than a quadrotor can be."""
    return bool(
        np.isfinite(motion.pos_w).all()
        and (np.abs(motion.vel_w) <= rules.speed_limit).all()
        and (np.abs(motion.rate_b) <= rules.rate_limit).all()
    )


def _padded(values: np.ndarray, rows: int) -> np.ndarray:
    """Return the first row of `values`, followed by rows of zeros."""
    padded = np.zeros((rows, *values.shape[1:]), np.float32)
    padded[0] = values[0]
    return padded


def assert_alike(found, wanted):
    """Check that two results are equal; on Python 3.13, whose packages differ, to 1e-9."""
    for one, other in zip(found, wanted, strict=True):
        is_number = isinstance(other, float) and sys.version_info >= (3, 13)
        assert one == (pytest.approx(other, rel=1e-9, abs=1e-12) if is_number else other)
