"""The catalogue of injected faults: each changes the signals of a flight or its vehicle file.

Most faults are made by a reading: an expression such as "rate=x,-y,z" that converts a signal, here
a correct one into a wrong one (`eval.logs.faults.reading`). "race" marks faults that ended flights
in a vision race.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from eval.effects.interface import GRAVITY
from eval.logs.faults.reading import parse_readings, read_rows
from eval.vehicles.vehicle import Vehicle
from suite.experiments.injected.changes import (
    COMMANDS,
    Signals,
    add_throttle_bias,
    arms_in_mm,
    drained,
    drop_barometer,
    drop_rotor_speeds,
    hold_commands,
    hold_rotor_speeds,
    jitter_stamps,
    linear_stick_map,
    map_of,
    other_curve,
    remove_gravity,
    set_pose_clock,
    shift,
    speed_up_pose_clock,
    turn_attitude,
    unlinearised,
    with_motors,
    with_rotors,
)

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
        ("accelerometer_gravity",), change=remove_gravity, needs=("acc", "quat")
    ),
    "accelerometer's bias with throttle": Kind(
        ("accelerometer_throttle_bias",),
        change=add_throttle_bias,
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
    "velocity through the air": Kind(
        ("velocity_mean",),
        change=lambda p, _: {**p, "vel": p["vel"] + [2.0, 1.0, 0.0]},
        needs=("pos", "vel"),
    ),
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
    "compass off by 15 deg": Kind(("heading",), change=turn_attitude, needs=("pos", "quat")),
    "position late by 150 ms": Kind(
        ("position_delay",),
        change=partial(shift, late_s=0.15, names=("pos", "vel")),
        needs=("pos", "quat"),
    ),
    "set point 150 ms ahead as position": Kind(
        ("position_delay",),
        change=partial(shift, late_s=-0.15, names=("pos", "vel")),
        needs=("pos", "quat"),
    ),
    "pose late by 60 ms": Kind(
        ("clock_offset",),
        change=partial(shift, late_s=0.06, names=("pos", "vel", "quat")),
        needs=("quat", "vel", "rate"),
    ),
    "pose's clock off by 0.5 %": Kind(
        ("clock_drift",), change=speed_up_pose_clock, needs=("quat", "rate")
    ),
    "pose's clock set by 60 ms in flight": Kind(
        ("clock_drift",), change=set_pose_clock, needs=("quat", "rate")
    ),
    "stamps of arrival, up to 80 % of a row late": Kind(
        ("clock_jitter",), change=jitter_stamps, needs=("pos", "quat", "rate")
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
    "rotor speeds held for 0.1 s": Kind(
        ("motor_telemetry",), change=hold_rotor_speeds, needs=("motor",)
    ),
    "rotor speeds that drop out": Kind(
        ("motor_telemetry",), change=drop_rotor_speeds, needs=("motor",)
    ),
    "rotor speeds late by 60 ms": Kind(
        ("motor_telemetry",),
        change=partial(shift, late_s=0.06, names=("motor",)),
        needs=("motor", "rate"),
    ),
    "motor 4 is a copy of motor 3": Kind(
        ("motor_telemetry",),
        change=lambda p, _: {**p, "motor": p["motor"][:, [0, 1, 2, 2]]},
        needs=("motor",),
    ),
    "spin of all motors": Kind(
        ("motor_spin",),
        vehicle=lambda v: with_rotors(v, spin=tuple(-s for s in v.rotors.spin)),
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
        ("rate_curve",), change=linear_stick_map, race=True, needs=("cmd_rate", "rate")
    ),
    "commands act 150 ms later": Kind(
        ("command_delay",),
        change=partial(shift, late_s=-0.15, names=COMMANDS),
        needs=("cmd_rate", "rate", "throttle"),
    ),
    "loop at two thirds of its rate (20 of 30 Hz)": Kind(
        ("controller_rate",),
        change=hold_commands,
        race=True,
        needs=("cmd_rate", "throttle"),
    ),
    # The other formats define the unit of time.
    "time in ms": Kind(
        ("time_unit",),
        change=lambda p, _: {**p, "time": 1e3 * p["time"]},
        formats=("table", "flight log"),
    ),
    "clock 6 % too slow": Kind(
        ("time_unit",),
        change=lambda p, _: {**p, "time": 0.94 * p["time"]},
        needs=("pos", "quat", "vel", "rate"),
        formats=("table", "flight log"),
    ),
    "throttle is a share of the motors' speed": Kind(
        ("throttle_curve",), change=unlinearised, needs=("throttle", "cmd_thrust")
    ),
    "motor map of another curve": Kind(("motor_map",), vehicle=other_curve, needs=("pwm",)),
    "motor map of twice the thrust": Kind(
        ("motor_map",),
        vehicle=lambda v: with_motors(v, thrust=tuple(2.0 * t for t in map_of(v).thrust)),
        needs=("pwm",),
    ),
    "battery compensated twice": Kind(
        ("battery_scaling",),
        change=drained,
        vehicle=lambda v: with_motors(v, voltage_exponent=map_of(v).voltage_exponent + 1.5),
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
    "arms in mm": Kind(("vehicle_arms",), vehicle=arms_in_mm),
    "speed_max in rpm": Kind(
        ("vehicle_thrust",),
        vehicle=lambda v: with_rotors(v, speed_max=RPM * v.rotors.speed_max),
    ),
    "inertia x 1000": Kind(
        ("vehicle_inertia",),
        vehicle=lambda v: replace(
            v, inertia=(1e3 * v.inertia[0], 1e3 * v.inertia[1], 1e3 * v.inertia[2])
        ),
    ),
    "barometer falls on spin-up": Kind(
        ("barometer_spin_up",),
        change=drop_barometer,
        race=True,
        needs=("baro", "motor", "throttle"),
    ),
    "field of view": Kind(("camera_fov",), fov=1.25, race=True),
    "thrust -10 %": Kind(
        ("thrust_scale",),
        race=True,
        vehicle=lambda v: with_rotors(v, thrust_coefficient=v.rotors.thrust_coefficient / 0.9),
        needs=("motor", "pos", "quat"),
    ),
}
"""Name of each kind of fault -> the fault."""
