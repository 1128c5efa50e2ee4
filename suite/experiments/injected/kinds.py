"""The catalogue of injected faults: each changes the signals of a flight or its vehicle file.

Most faults are made by a reading: an expression such as "rate=x,-y,z" that converts a signal, here
a correct one into a wrong one (`eval.logs.faults.reading`). "race" marks faults that ended flights
in a vision race.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.frames import conjugate, multiply, rotate
from eval.logs.faults.reading import parse_readings, read_rows
from eval.vehicles.vehicle import MotorMap, Vehicle

Signals = dict[str, np.ndarray]
"""Signal -> (T, C) values at T times in C components, in SI units and the suite's frames; `time` is
(T,) [s]."""
DEG = float(180.0 / np.pi)
"""Degrees in a radian."""
RPM = float(60.0 / (2.0 * np.pi))
"""Revolutions per minute in a radian per second."""


@dataclass(frozen=True)
class Kind:
    """A kind of fault."""

    names: tuple[str, ...]
    """Names in `eval.logs.faults.catalogue`, one of which must be reported."""
    readings: tuple[str, ...] = ()
    """Readings that corrupt the signals."""
    change: Callable[[Signals, Vehicle], Signals] | None = None
    """Change of the signals that no reading can describe."""
    vehicle: Callable[[Vehicle], Vehicle] | None = None
    """Change of the vehicle file."""
    fov: float = 1.0
    """Field of view of the policy, as a factor of that of the vehicle."""
    race: bool = False
    """Whether it ended flights of teams in a vision race of 2026."""
    needs: tuple[str, ...] = ()
    """Signals that `change` reads, and signals without which the fault is not identifiable."""
    formats: tuple[str, ...] = ()
    """Log formats that can have the fault; all if empty."""
    accepts_pwm: bool = False
    """Whether motor commands (`pwm`) may stand in for rotor speeds (`motor`), if a log has only
    the commands."""

    def fits(self, signals: set[str]) -> bool:
        """Return whether the fault can be injected into a log with these signals."""
        # A reading that starts with "from-" turns a signal by the attitude.
        attitude = {"quat"} if any("from-" in text for text in self.readings) else set()
        needed = {*self.needs, *attitude, *(text.partition("=")[0] for text in self.readings)}
        use_pwm = self.accepts_pwm and "pwm" in signals
        return needed <= (signals | {"motor"} if use_pwm else signals)


def inject(kind: Kind, signals: Mapping[str, np.ndarray], vehicle: Vehicle) -> Signals:
    """Return the signals of a correct flight of `vehicle`, with the fault."""
    faulty, readings = dict(signals), parse_readings(kind.readings)
    only_pwm = kind.accepts_pwm and "motor" not in faulty
    if only_pwm:
        faulty["motor"] = faulty.pop("pwm")
    elif kind.accepts_pwm and "pwm" in faulty:
        # A log has the commands of the motors in the same order as their speeds.
        faulty["pwm"] = read_rows({**faulty, "motor": faulty["pwm"]}, readings)["motor"]
    faulty = read_rows(faulty, readings)
    faulty = kind.change(faulty, vehicle) if kind.change is not None else faulty
    if only_pwm:
        faulty["pwm"] = faulty.pop("motor")
    return faulty


def _remove_gravity(signals: Signals, _: Vehicle) -> Signals:
    """Log the acceleration without gravity; an accelerometer at rest shows it as 9.81 upwards."""
    gravity_b = rotate(conjugate(signals["quat"]), np.array([0.0, 0.0, GRAVITY]))
    return {**signals, "acc": signals["acc"] - gravity_b}


def _add_throttle_bias(signals: Signals, _: Vehicle) -> Signals:
    """Add a vertical accelerometer error that grows with the square of the throttle."""
    bias = -0.46 * GRAVITY * signals["throttle"] ** 2
    return {**signals, "acc": signals["acc"] + bias * [0.0, 0.0, 1.0]}


def _linear_stick_map(signals: Signals, _: Vehicle) -> Signals:
    """Log commands of a linear stick map; the firmware's curve gives 0.62 to 2.4 times as much."""
    command = signals["cmd_rate"]
    largest = np.maximum(np.quantile(np.abs(command), 0.98, axis=0), 1e-6)
    share = np.clip(np.abs(command) / largest, 0.0, 1.5)
    # The curve is share = LINEAR stick + SQUARE stick^2, solved for the stick.
    stick = (-LINEAR + np.sqrt(LINEAR**2 + 4.0 * SQUARE * share)) / (2.0 * SQUARE)
    return {**signals, "cmd_rate": np.sign(command) * stick * largest}


def _log_commands_early(signals: Signals, _: Vehicle) -> Signals:
    """Log commands 150 ms before they act."""
    count = round(0.15 / float(np.median(np.diff(signals["time"]))))
    early = {n: np.roll(signals[n], -count, axis=0) for n in ("cmd_rate", "throttle", "cmd_thrust")}
    return {**signals, **early}


def _hold_commands(signals: Signals, _: Vehicle) -> Signals:
    """Update commands at two thirds of the policy's rate: 20 instead of 30 Hz."""
    step = float(np.median(np.diff(signals["time"])))
    # Time of the last update before each row, and the row at that time.
    update_s = np.floor(signals["time"] * 20.0 + 1e-6) / 20.0
    index = np.clip(np.round((update_s - signals["time"][0]) / step).astype(int), 0, None)
    return {**signals, **{n: signals[n][index] for n in ("cmd_rate", "throttle", "cmd_thrust")}}


def _turn_attitude(signals: Signals, _: Vehicle) -> Signals:
    """Log an attitude whose heading is off by 15 deg."""
    half = np.radians(7.5)
    turn = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
    quat = signals["quat"]
    return {**signals, "quat": multiply(np.broadcast_to(turn, quat.shape), quat)}


def _move_position(signals: Signals, _: Vehicle, late_s: float) -> Signals:
    """Log position and velocity late by `late_s` [s], early if it is negative."""
    count = round(late_s / float(np.median(np.diff(signals["time"]))))
    moved = {n: np.roll(signals[n], count, axis=0) for n in ("pos", "vel") if n in signals}
    kept = slice(max(count, 0), min(count, 0) or None)
    return {name: value[kept] for name, value in {**signals, **moved}.items()}


def _delay_pose(signals: Signals, _: Vehicle) -> Signals:
    """Log position, velocity and attitude 60 ms late; the last rows of the flight are lost."""
    count = round(0.06 / float(np.median(np.diff(signals["time"]))))
    others = {n: v[count:] for n, v in signals.items() if n not in ("pos", "vel", "quat")}
    return {**others, **{n: signals[n][:-count] for n in ("pos", "vel", "quat")}}


def _speed_up_pose_clock(signals: Signals, _: Vehicle) -> Signals:
    """Stamp position, velocity and attitude by a clock that runs 0.5 % fast."""
    time_s = signals["time"]
    true_s = time_s - 0.005 * (time_s - time_s.mean())
    stretched = {
        n: np.stack([np.interp(true_s, time_s, c) for c in signals[n].T], axis=1)
        for n in ("pos", "vel", "quat")
        if n in signals
    }
    stretched["quat"] /= np.linalg.norm(stretched["quat"], axis=1, keepdims=True)
    return {**signals, **stretched}


def _jitter_stamps(signals: Signals, _: Vehicle) -> Signals:
    """Stamp each row by the arrival of its message, late by up to 80 % of the time to the next."""
    time_s, rng = signals["time"], np.random.default_rng(0)
    step_s = np.diff(time_s, append=2.0 * time_s[-1] - time_s[-2])
    return {**signals, "time": time_s + rng.uniform(0.0, 0.8, len(time_s)) * step_s}


def _drop_barometer(signals: Signals, _: Vehicle) -> Signals:
    """Add two seconds on the ground; then the barometer falls by 1.6 m as the motors start."""
    step = float(np.median(np.diff(signals["time"])))
    count = round(2.0 / step)
    ground = {n: np.repeat(v[:1], count, axis=0) for n, v in signals.items() if n != "time"}
    for name in ("motor", "throttle", "cmd_thrust", "vel", "rate", "cmd_rate"):
        ground[name] = 0.0 * ground[name]
    joined = {n: np.concatenate([v, signals[n]]) for n, v in ground.items()}
    joined["time"] = signals["time"][0] + step * np.arange(count + len(signals["time"]))
    joined["baro"][count:] -= 1.6
    return joined


def _unlinearised(signals: Signals, _: Vehicle) -> Signals:
    """The firmware does not linearise the throttle: thrust grows with its square."""
    share = np.sqrt(np.clip(signals["throttle"], 0.0, None))
    full = np.median(signals["cmd_thrust"]) / np.median(signals["throttle"])
    return {**signals, "throttle": share, "cmd_thrust": full * share}


def _drained(signals: Signals, _: Vehicle) -> Signals:
    """A flight to an empty battery, which the firmware compensates."""
    time_s = signals["time"]
    left = np.interp(time_s, (time_s[0], time_s[-1]), (1.05, 0.8))
    return {**signals, "voltage": signals["voltage"] * left[:, None]}


def _map_of(vehicle: Vehicle) -> MotorMap:
    assert vehicle.motors is not None
    return vehicle.motors


def _motors(vehicle: Vehicle, **changes: Any) -> Vehicle:
    return replace(vehicle, motors=replace(_map_of(vehicle), **changes))


def _other_curve(vehicle: Vehicle) -> Vehicle:
    """A linear curve in place of a quadratic one or the reverse, equal at half command."""
    linear, square = _map_of(vehicle).thrust
    half = 0.5 * linear + 0.25 * square
    return _motors(
        vehicle, thrust=(0.0, 4.0 * half) if linear > 0.5 * square else (2.0 * half, 0.0)
    )


def _with_rotors(vehicle: Vehicle, **changes: Any) -> Vehicle:
    """Return `vehicle` with other values for fields of its rotors."""
    return replace(vehicle, rotors=replace(vehicle.rotors, **changes))


def _arms_in_mm(vehicle: Vehicle) -> Vehicle:
    """Return `vehicle` with rotor positions in millimetres, which a reader takes for metres."""
    hubs = tuple(tuple(1000.0 * c for c in hub) for hub in vehicle.rotors.position)
    return _with_rotors(vehicle, position=hubs)


LINEAR, SQUARE = 0.62, 1.78
"""Coefficients of the firmware's curve: body rate = LINEAR stick + SQUARE stick^2, where rate and
stick are relative to typical large values (the 98 % quantile of the rate)."""
ALL_FRD = tuple(f"{name}=x,-y,-z" for name in ("rate", "acc", "cmd_rate"))
"""Readings that convert all body signals to forward-right-down axes."""
KINDS: dict[str, Kind] = {
    "gyro in deg/s": Kind(("gyro_scale",), (f"rate={DEG}",)),
    "gyro in raw counts (x16.384)": Kind(("gyro_scale",), (f"rate={16.384 * DEG}",), race=True),
    "gyro 20 % too large": Kind(("gyro_scale",), ("rate=1.2",)),
    "gyro in rad/s, taken for deg/s": Kind(("gyro_scale",), (f"rate={1.0 / DEG}",)),
    "pitch of the gyro inverted": Kind(("gyro_axes",), ("rate=x,-y,z",), race=True),
    "gyro forward-right-down": Kind(("body_frame",), ("rate=x,-y,-z",)),
    "gyro's x and y swapped": Kind(("gyro_axes",), ("rate=y,x,z",)),
    "rates in world axes": Kind(("gyro_frame",), ("rate=from-body",)),
    "accelerometer in g": Kind(("accelerometer_unit",), (f"acc={1.0 / GRAVITY}",)),
    "accelerometer in counts": Kind(("accelerometer_unit",), (f"acc={2048.0 / GRAVITY}",)),
    "accelerometer's sign": Kind(("accelerometer_axes",), ("acc=-x,-y,-z",)),
    "accelerometer forward-right-down": Kind(
        ("accelerometer_axes", "body_frame"), ("acc=x,-y,-z",)
    ),
    "gravity removed": Kind(
        ("accelerometer_gravity",), change=_remove_gravity, needs=("acc", "quat")
    ),
    "accelerometer's bias with throttle": Kind(
        ("accelerometer_throttle_bias",),
        change=_add_throttle_bias,
        race=True,
        needs=("acc", "throttle", "pos", "quat"),
    ),
    "position in mm": Kind(("position_unit",), ("pos=1000",)),
    "position in cm": Kind(("position_unit",), ("pos=100",)),
    "position north-east-down": Kind(("world_frame",), ("pos=x,-y,-z",)),
    "position's y inverted": Kind(("position_axes",), ("pos=x,-y,z",)),
    "position's z inverted": Kind(("position_axes",), ("pos=x,y,-z",)),
    "velocity north-east-down": Kind(("velocity_frame",), ("vel=x,-y,-z",)),
    "velocity in body axes": Kind(("velocity_frame",), ("vel=from-world",)),
    "velocity turned twice": Kind(("velocity_frame",), ("vel=from-body",)),
    "velocity in cm/s": Kind(("velocity_unit",), ("vel=100",)),
    "all of it north-east-down": Kind(
        ("world_frame",), ("quat=ned+frd", "pos=x,-y,-z", "vel=x,-y,-z", *ALL_FRD)
    ),
    "body forward-right-down": Kind(("body_frame",), ("quat=frd", *ALL_FRD)),
    "quaternion xyzw": Kind(("quaternion_order",), ("quat=xyzw+xyzw+xyzw",)),
    "quaternion wxyz, read as xyzw": Kind(("quaternion_order",), ("quat=xyzw",)),
    "quaternion world to body": Kind(("quaternion_direction",), ("quat=inverse",)),
    "attitude's pitch and odometry's roll inverted": Kind(
        ("attitude_sign",), ("quat=-pitch", "rate=-x,y,z"), race=True
    ),
    "compass off by 15 deg": Kind(("heading",), change=_turn_attitude, needs=("pos", "quat")),
    "position late by 150 ms": Kind(
        ("position_delay",), change=partial(_move_position, late_s=0.15), needs=("pos", "quat")
    ),
    "set point 150 ms ahead as position": Kind(
        ("position_delay",), change=partial(_move_position, late_s=-0.15), needs=("pos", "quat")
    ),
    "pose late by 60 ms": Kind(
        ("clock_offset",), change=_delay_pose, needs=("quat", "vel", "rate")
    ),
    "pose's clock off by 0.5 %": Kind(
        ("clock_drift",), change=_speed_up_pose_clock, needs=("quat", "rate")
    ),
    "stamps of arrival, up to 80 % of a row late": Kind(
        ("clock_jitter",), change=_jitter_stamps, needs=("pos", "quat", "rate")
    ),
    "rotor speeds in rpm": Kind(("motor_unit",), (f"motor={RPM}",)),
    "electrical rotor speeds": Kind(("motor_unit",), ("motor=7",)),
    "12 poles declared of 14": Kind(("motor_poles",), (f"motor={14.0 / 12.0}",)),
    "motors in the order 2, 1, 4, 3": Kind(("motor_order",), ("motor=2,1,4,3",), accepts_pwm=True),
    "motors in the order 4, 1, 2, 3": Kind(("motor_order",), ("motor=4,1,2,3",), accepts_pwm=True),
    "motors 3 and 4 swapped": Kind(("motor_order",), ("motor=1,2,4,3",), accepts_pwm=True),
    "motor 3 never turns": Kind(
        ("motor_dead",),
        change=lambda p, _: {**p, "motor": p["motor"] * [1.0, 1.0, 0.0, 1.0]},
        needs=("motor",),
        accepts_pwm=True,
    ),
    "spin of all motors": Kind(
        ("motor_spin",),
        vehicle=lambda v: _with_rotors(v, spin=tuple(-s for s in v.rotors.spin)),
        needs=("motor", "rate"),
        accepts_pwm=True,
    ),
    "thrust command in g": Kind(
        ("thrust_command_unit",), (f"cmd_thrust={1.0 / GRAVITY}",), needs=("quat", "pos")
    ),
    "thrust command in newtons": Kind(
        ("thrust_command_unit",),
        change=lambda p, vehicle: {**p, "cmd_thrust": vehicle.mass * p["cmd_thrust"]},
        needs=("cmd_thrust", "quat", "pos"),
    ),
    "thrust command with down positive": Kind(
        ("thrust_command_unit",), ("cmd_thrust=-1",), needs=("quat", "pos")
    ),
    "throttle from 0 to 1000": Kind(("throttle_range",), ("throttle=1000",)),
    "throttle in percent": Kind(("throttle_range",), ("throttle=100",)),
    "rate command in deg/s": Kind(("rate_command_unit",), (f"cmd_rate={DEG}",)),
    "sign of the yaw command": Kind(("rate_command_sign",), ("cmd_rate=x,y,-z",)),
    "linear stick map against a rates curve": Kind(
        ("rate_curve",), change=_linear_stick_map, race=True, needs=("cmd_rate", "rate")
    ),
    "commands act 150 ms later": Kind(
        ("command_delay",), change=_log_commands_early, needs=("cmd_rate", "rate", "throttle")
    ),
    "loop at two thirds of its rate (20 of 30 Hz)": Kind(
        ("controller_rate",), change=_hold_commands, race=True, needs=("cmd_rate", "throttle")
    ),
    # The other formats define the unit of time.
    "time in ms": Kind(
        ("time_unit",),
        change=lambda p, _: {**p, "time": 1e3 * p["time"]},
        formats=("table", "flight log"),
    ),
    "throttle is a share of the motors' speed": Kind(
        ("throttle_curve",), change=_unlinearised, needs=("throttle", "cmd_thrust")
    ),
    "motor map of another curve": Kind(("motor_map",), vehicle=_other_curve, needs=("pwm",)),
    "motor map of twice the thrust": Kind(
        ("motor_map",),
        vehicle=lambda v: _motors(v, thrust=tuple(2.0 * t for t in _map_of(v).thrust)),
        needs=("pwm",),
    ),
    "battery compensated twice": Kind(
        ("battery_scaling",),
        change=_drained,
        vehicle=lambda v: _motors(v, voltage_exponent=_map_of(v).voltage_exponent + 1.5),
        needs=("pwm", "voltage"),
    ),
    "voltage in mV": Kind(("voltage",), ("voltage=1000",)),
    "battery of 0.1 V": Kind(("voltage",), ("voltage=0.00625",)),
    "mass on five links": Kind(
        ("vehicle_mass", "vehicle_thrust"),
        vehicle=lambda v: replace(v, mass=5.0 * v.mass),
        race=True,
        needs=("motor",),
    ),
    "arms in mm": Kind(("vehicle_arms",), vehicle=_arms_in_mm),
    "speed_max in rpm": Kind(
        ("vehicle_thrust",), vehicle=lambda v: _with_rotors(v, speed_max=RPM * v.rotors.speed_max)
    ),
    "inertia x 1000": Kind(
        ("vehicle_inertia",),
        vehicle=lambda v: replace(
            v, inertia=(1e3 * v.inertia[0], 1e3 * v.inertia[1], 1e3 * v.inertia[2])
        ),
    ),
    "barometer falls on spin-up": Kind(
        ("barometer_spin_up",),
        change=_drop_barometer,
        race=True,
        needs=("baro", "motor", "throttle"),
    ),
    "field of view": Kind(("camera_fov",), fov=1.25, race=True),
    "thrust -10 %": Kind(
        ("thrust_scale",),
        race=True,
        vehicle=lambda v: _with_rotors(v, thrust_coefficient=v.rotors.thrust_coefficient / 0.9),
        needs=("motor", "pos", "quat"),
    ),
}
"""Name of each kind of fault -> the fault."""
