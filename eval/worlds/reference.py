"""The simulator `reference`: one trial as a loop of MuJoCo steps, in one readable function.

Tests compare the batched simulators with it. It shares the vehicle with them and nothing else: it
counts gates and ends a trial by its own code.
"""

from __future__ import annotations

import mujoco
import numpy as np

from eval.judging.guard import ActionLimits, Guarded, call_policy, first_action, limits_of
from eval.judging.outputs import Outputs
from eval.judging.sensors import Sensors
from eval.quadrotor.autopilot import autopilot_step, make_autopilot, start_autopilot
from eval.quadrotor.plant import Motion, uses_noise
from eval.sensors import sensing
from eval.sensors.sensors_file import PERFECT, SensorSet
from eval.vehicles.vehicle import Vehicle
from eval.worlds import REFERENCE
from eval.worlds.engine import Eye, compile_model, contact_name, motion_of, start_state
from eval.worlds.slots import layout_of, noise_of
from eval.worlds.trial import Rules, TrialResult, TrialSpec
from policies.observation import observe, view_of
from policies.policy import Policy
from tracks.geometry.crossing import crossing, is_near
from tracks.geometry.rotation import to_world
from tracks.geometry.scene import Gates
from tracks.track import Track


def fly_trial(
    policy: Policy,
    trial: TrialSpec,
    track: Track,
    vehicle: Vehicle,
    rules: Rules | None = None,
    limits: ActionLimits | None = None,
    rows: int = 64,
    wanted: SensorSet = PERFECT,
) -> TrialResult:
    """Fly one trial.

    Args:
        policy: the policy.
        trial: its family, level and seed.
        track: the trial's.
        vehicle: what it flies.
        rules: when a trial ends.
        limits: what an action may be.
        rows: number of rows of the policy's inputs, as in the batched simulators, since the output
            of some policies depends on it; all rows but the first are zero.
        wanted: errors in what the policy sees.

    Raises:
        ValueError: for delayed or filtered observations, which this simulator does not have.
    """
    if wanted.is_late or wanted.estimator:
        lacks = "has no estimator in the loop" if wanted.estimator else "shows nothing late"
        raise ValueError(f"world 'reference' {lacks}; fly in 'mujoco', which flies alike")
    rules, limits = rules or Rules(), limits or ActionLimits()
    autopilot = make_autopilot(vehicle, policy.spec.action)
    dt, spec = autopilot.dt, policy.spec
    model = compile_model(track, vehicle, dt, layout_of([track]).solids)
    data = mujoco.MjData(model)
    data.qpos[:] = start_state(track)
    mujoco.mj_step1(model, data)  # contacts of the first state
    gates, count = track.scene.gates, len(track.scene.gates.center_w)
    draws = np.zeros((1, 3))
    if uses_noise(autopilot.plant):
        draws = noise_of(trial, round(rules.time_limit_s / dt) + 2)
    eye, hidden = Eye(spec.camera), policy.start(rows)
    loops = start_autopilot(autopilot, motion_of(data), draws[:1] if len(draws) > 1 else None)
    sensors = None
    if sensing(wanted.models):
        sensors = Sensors(wanted, 1, spec.rate_hz, spec.camera)
        sensors.start(0, trial)
    limits, action_b = (
        limits_of(limits, spec.action, vehicle),
        first_action(spec.action, vehicle)[None],
    )
    outputs, bad, limited, late, decisions = Outputs(1, spec.action), 0, 0, 0, 0
    passed = passed_8s = passed_035 = 0
    speeds: list[float] = []
    before_w = data.qpos[:3].copy()
    ended_by, collided_with, step = None, None, 0

    while True:
        # Judge the state that the last step led to.
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
                passed_035 += bool(is_near(near_w, pos_w, rules.near_radius_m))
            if passed == count:
                ended_by = "finished"
            elif motion.rot_w[0, 2, 2] < 0:
                ended_by = "tipped"
            elif step >= round(rules.time_limit_s / dt):
                ended_by = "timeout"
        if step <= round(rules.short_window_s / dt):
            passed_8s = passed
        before_w = pos_w
        if ended_by is not None:
            break

        # Ask the policy when it is its time.
        gate_w = gates.center_w[None, passed]
        if step == np.rint(decisions * (1 / (spec.rate_hz * dt))):
            depth = eye.image(model, data, pos_w, motion.rot_w[0])
            numbers = (passed, min(passed + 1, count - 1))
            gate, after = (Gates(*(field[[number]] for field in gates)) for number in numbers)
            seen = view_of(motion.pos_w, motion.rot_w, motion.vel_w, gate, after, depth[None])
            if sensors:
                seen = seen._replace(gate_number=np.array([passed]))
                seen = sensors.see(seen, np.array([decisions == 0]), np.array([True]))
            state, image = observe(spec, seen, action_b)
            fresh = np.full(rows, decisions == 0)
            inputs = (_padded(x, rows) for x in (state, image))
            last_b = np.repeat(action_b, rows, 0)
            guarded, hidden = call_policy(limits, policy, hidden, *inputs, fresh, last_b)
            action_b = guarded.action_b[:1]
            outputs.add(Guarded(*(part[:1] for part in guarded)), state.astype(np.float32))
            bad, limited = bad + int(guarded.bad[0]), limited + int(guarded.limited[0])
            decisions += 1
            if guarded.late[0]:
                ended_by, late = "timeout", 1
                break

        # Fly one step.
        blow = draws[None, step + 1] if len(draws) > 1 else None
        loops, wrench = autopilot_step(
            autopilot, loops, motion, action_b, gate_w, np.array([step]), blow
        )
        step += 1
        if not (np.abs([wrench.force_b, wrench.torque_b]) <= rules.wrench_limit).all():
            ended_by = "diverged"
            break
        data.qfrc_applied[:3] = to_world(motion.rot_w, wrench.force_b)[0]
        data.qfrc_applied[3:] = wrench.torque_b[0]
        mujoco.mj_step2(model, data)
        mujoco.mj_step1(model, data)

    # The speed at a contact is not "before any contact".
    free = speeds[:-1] if ended_by == "collision" else speeds
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
        v_max=max(free, default=0.0),
        v_mean=sum(speeds) / max(len(speeds), 1),
        gates_8s=passed_8s,
        gates_035=passed_035,
        bad_actions=bad,
        limited_actions=limited,
        late_actions=late,
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
    padded = np.zeros((rows, *values.shape[1:]), np.float32)
    padded[0] = values[0]
    return padded
