"""Do velocity, attitude and accelerometer fit the path? Tells frames that were mixed up.

The velocity must be the path's derivative. The force that bends the path (acceleration less
gravity) must point along the body's z axis but for drag, which tells north-east-down from z-up,
in the world and in the body. The accelerometer must show that force.
"""

from __future__ import annotations

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.checks.attitude import BAD, GOOD, TIMES_BETTER
from eval.importers.findings import Finding
from eval.importers.frames import BODY_VECTORS, HALF_TURN, QUAT_HALF_TURN, conjugate, turn
from eval.logs.velocity import velocity_from_position

CALM_SPEED, CALM_ACC = 0.3, 1.0
"""Below these [m/s, m/s^2], root mean square, a flight tells nothing."""
UNITS = {"m/s": 1.0, "cm/s": 0.01, "mm/s": 1e-3}


def check_velocity(rows: dict[str, np.ndarray], fix: bool) -> list[Finding]:
    """Hold the velocity against the path's derivative; correct `rows` in place under `fix`."""
    if "vel" not in rows:
        return [Finding("note", "velocity", "not in the file; it is derived from the positions")]
    path = velocity_from_position(rows["time"], rows["pos"])
    vel, quat = rows["vel"], rows["quat"]
    speed = _rms(path)
    if speed < CALM_SPEED:
        text = f"a speed of {speed:.2g} m/s is too little to check the velocity by"
        return [Finding("note", "velocity", text)]
    readings = {
        "in world axes": vel,
        "in body axes": turn(quat, vel),
        "in a north-east-down world": vel * HALF_TURN,
        "in forward-right-down body axes": turn(quat, vel * HALF_TURN),
    }
    residual = {
        (frame, unit): _rms(reading * scale - path) / speed
        for frame, reading in readings.items()
        for unit, scale in UNITS.items()
    }
    given = residual["in world axes", "m/s"]
    best = min(residual, key=lambda pair: residual[pair])
    figures = f"it is off the path's derivative by {100 * given:.0f} %"
    if given < BAD or not (residual[best] < GOOD and residual[best] * TIMES_BETTER < given):
        # A derived velocity is noisy where positions are; only a large misfit is a doubt.
        return [Finding("ok" if given < BAD else "doubt", "velocity", figures)]
    frame, unit = best
    where = frame if unit == "m/s" else f"{frame} and {unit}"
    text = f"{figures}, but by {100 * residual[best]:.0f} % if it is {where}"
    if not fix:
        return [Finding("doubt", "velocity", text + "; left as it is")]
    rows["vel"] = readings[frame] * UNITS[unit]
    return [Finding("corrected", "velocity", text)]


def check_frames(rows: dict[str, np.ndarray], fix: bool) -> list[Finding]:
    """Tell north-east-down and forward-right-down from z-up; correct `rows` under `fix`.

    Velocity and position are taken to be in one world; `check_velocity` runs before.
    """
    acc_w = _acceleration(rows)
    level = _rms(acc_w[:, :2])
    if level < CALM_ACC:
        text = f"accelerations of {level:.2g} m/s^2 are too small to tell NED from z-up"
        return [Finding("note", "frames", text)]
    residual = {
        (world, body): _lateral(acc_w, rows["quat"], world, body) / level
        for world in (False, True)
        for body in (False, True)
    }
    given = residual[False, False]
    best = min(residual, key=lambda pair: residual[pair])
    figures = f"the force off the body's z axis is {100 * given:.0f} % of the acceleration"
    if given < BAD or not (residual[best] < BAD and residual[best] * TIMES_BETTER < given):
        fine = Finding("ok", "frames", figures + ": z-up world, forward-left-up body")
        return [fine if given < BAD else Finding("doubt", "frames", figures)]
    world, body = best
    words = ["positions and velocities are in north-east-down"] if world else []
    words += ["the attitude is that of a forward-right-down body"] if body else []
    text = f"{figures}, but {100 * residual[best]:.0f} % if " + " and ".join(words)
    if not fix:
        return [Finding("doubt", "frames", text + "; left as they are")]
    for name in ("pos", "vel") if world else ():
        if name in rows:
            rows[name] = rows[name] * HALF_TURN
    if body:
        for name in ("quat", "cmd_quat"):
            if name in rows:
                rows[name] = rows[name] * QUAT_HALF_TURN
        for name in BODY_VECTORS:
            if name in rows:
                rows[name] = rows[name] * HALF_TURN
    return [Finding("corrected", "frames", text)]


def check_accelerometer(rows: dict[str, np.ndarray], fix: bool) -> list[Finding]:
    """Hold the accelerometer against the force that bends the path; correct `rows` under `fix`."""
    if "acc" not in rows:
        return []
    force = turn(conjugate(rows["quat"]), _acceleration(rows) + [0.0, 0.0, GRAVITY])
    acc = rows["acc"]
    size = _rms(force)
    readings = {
        "specific force in m/s^2": acc,
        "in g": GRAVITY * acc,
        "of the other sign": -acc,
        "in g and of the other sign": -GRAVITY * acc,
        "in forward-right-down axes": acc * HALF_TURN,
        "in g and forward-right-down axes": GRAVITY * acc * HALF_TURN,
    }
    residual = {name: _rms(reading - force) / size for name, reading in readings.items()}
    given = residual["specific force in m/s^2"]
    best = min(residual, key=lambda name: residual[name])
    figures = f"it is off the path's acceleration less gravity by {100 * given:.0f} %"
    if given < BAD or not (residual[best] < GOOD and residual[best] * TIMES_BETTER < given):
        return [Finding("ok" if given < BAD else "doubt", "accelerometer", figures)]
    text = f"{figures}, but by {100 * residual[best]:.0f} % if it is {best}"
    if not fix:
        return [Finding("doubt", "accelerometer", text + "; left as it is")]
    rows["acc"] = readings[best]
    return [Finding("corrected", "accelerometer", text)]


def check_rate_command(rows: dict[str, np.ndarray], fix: bool) -> list[Finding]:
    """Tell degrees from radians in the commanded rates, by how the gyro follows them."""
    if "cmd_rate" not in rows:
        return []
    command, rate = rows["cmd_rate"], rows["rate"]
    both = np.isfinite(command).all(axis=1) & np.isfinite(rate).all(axis=1)
    command, rate = command[both], rate[both]
    if len(rate) < 30:
        return [Finding("note", "rate command", "too few to check")]
    if min(_rms(command), _rms(rate)) == 0:
        still = "it" if _rms(command) == 0 else "the gyro"
        return [Finding("note", "rate command", f"{still} is 0 throughout")]
    alike = float(np.sum(command * rate) / np.sqrt(np.sum(command**2) * np.sum(rate**2)))
    ratio = _rms(command) / _rms(rate)
    figures = f"{ratio:.2g} times the gyro, correlation {alike:.2f}"
    if alike > 0.6 and 20.0 < ratio < 180.0:
        text = f"{figures}: in degrees per second"
        if fix:
            rows["cmd_rate"] = np.deg2rad(rows["cmd_rate"])
            return [Finding("corrected", "rate command", text)]
        return [Finding("doubt", "rate command", text + "; left as it is")]
    if alike < 0.2 and _rms(rate) > CALM_SPEED:
        return [Finding("doubt", "rate command", f"{figures}: the gyro does not follow it")]
    wrong = [axis for k, axis in enumerate("xyz") if _correlation(command[:, k], rate[:, k]) < -0.5]
    if wrong:
        axes = ", ".join(wrong)
        text = f"{figures}; the gyro moves against it about {axes}: check its sign"
        return [Finding("doubt", "rate command", text)]
    return [Finding("ok", "rate command", figures)]


def _correlation(first: np.ndarray, second: np.ndarray) -> float:
    size = np.sqrt(np.sum(first**2) * np.sum(second**2))
    return float(np.sum(first * second) / size) if size > 0 else 0.0


def _acceleration(rows: dict[str, np.ndarray]) -> np.ndarray:
    time_s = rows["time"]
    vel = rows.get("vel")
    vel = velocity_from_position(time_s, rows["pos"]) if vel is None else vel
    return velocity_from_position(time_s, vel)


def _lateral(acc_w: np.ndarray, quat: np.ndarray, world: bool, body: bool) -> float:
    acc = acc_w * HALF_TURN if world else acc_w
    attitude = quat * QUAT_HALF_TURN if body else quat
    return _rms(turn(conjugate(attitude), acc + [0.0, 0.0, GRAVITY])[:, :2])


def _rms(value: np.ndarray) -> float:
    """Return the root mean square of the lesser nine tenths: derivatives are wild beside holes."""
    squared = np.sum(value**2, axis=1)
    squared = np.sort(squared[np.isfinite(squared)])
    squared = squared[: max(1, int(0.9 * len(squared)))]
    return float(np.sqrt(np.mean(squared))) if len(squared) else 0.0
