"""Kinds of faults: the change of a good flight or of its vehicle file, and the fault's names.

Most are a reading (`eval.logs.faults.reading`) that corrupts a good signal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.frames import conjugate, rotate
from eval.logs.faults.reading import parse_readings, read_rows
from eval.vehicles.vehicle import Vehicle

Parts = dict[str, np.ndarray]
"""Signal to (T, C), `time` to (T,), in our units and frames."""
DEG = float(180.0 / np.pi)
RPM = float(60.0 / (2.0 * np.pi))


@dataclass(frozen=True)
class Kind:
    """One fault."""

    names: tuple[str, ...]
    """Names in `eval.logs.faults.catalogue`, of which one must be reported."""
    readings: tuple[str, ...] = ()
    """Readings that corrupt the flight."""
    change: Callable[[Parts, Vehicle], Parts] | None = None
    """A change that no reading describes."""
    vehicle: Callable[[Vehicle], Vehicle] | None = None
    """A change of the vehicle file."""
    fov: float = 1.0
    """The policy's field of view, as a factor of the vehicle's."""
    race: bool = False
    """Whether it has cost teams of a vision race of 2026 their flights."""
    of: tuple[str, ...] = ()
    """Signals that `change` needs, and those without which the fault is not identifiable."""
    drive: bool = False
    """The motors' commands (`pwm`) do where a log has no rotor speeds (`motor`)."""

    def fits(self, signals: set[str]) -> bool:
        """Return whether the fault can be put into a log of these signals."""
        turned = {"quat"} if any("from-" in text for text in self.readings) else set()
        needs = {*self.of, *turned, *(text.partition("=")[0] for text in self.readings)}
        return needs <= (signals | {"motor"} if self.drive and "pwm" in signals else signals)


def inject(kind: Kind, parts: Mapping[str, np.ndarray], vehicle: Vehicle) -> Parts:
    """Return a good flight of `vehicle` with the fault in it."""
    wrong = dict(parts)
    instead = kind.drive and "motor" not in wrong
    if instead:
        wrong["motor"] = wrong.pop("pwm")
    wrong = read_rows(wrong, parse_readings(kind.readings))
    wrong = kind.change(wrong, vehicle) if kind.change is not None else wrong
    if instead:
        wrong["pwm"] = wrong.pop("motor")
    return wrong


def _without_gravity(parts: Parts, _: Vehicle) -> Parts:
    down = rotate(conjugate(parts["quat"]), np.array([0.0, 0.0, GRAVITY]))
    return {**parts, "acc": parts["acc"] - down}


def _biased_by_throttle(parts: Parts, _: Vehicle) -> Parts:
    bias = -0.46 * GRAVITY * parts["throttle"] ** 2
    return {**parts, "acc": parts["acc"] + bias * [0.0, 0.0, 1.0]}


def _curved(parts: Parts, _: Vehicle) -> Parts:
    """A linear stick map; the firmware's curve gives 0.62 to 2.4 times as much."""
    command = parts["cmd_rate"]
    most = np.maximum(np.quantile(np.abs(command), 0.98, axis=0), 1e-6)
    share = np.clip(np.abs(command) / most, 0.0, 1.5)
    stick = (-0.62 + np.sqrt(0.62**2 + 4.0 * 1.78 * share)) / (2.0 * 1.78)
    return {**parts, "cmd_rate": np.sign(command) * stick * most}


def _dead(parts: Parts, _: Vehicle) -> Parts:
    return {**parts, "motor": parts["motor"] * [1.0, 1.0, 0.0, 1.0]}


def _newtons(parts: Parts, vehicle: Vehicle) -> Parts:
    return {**parts, "cmd_thrust": vehicle.mass * parts["cmd_thrust"]}


def _ahead(parts: Parts, _: Vehicle) -> Parts:
    """Commands act 150 ms later than logged."""
    count = round(0.15 / float(np.median(np.diff(parts["time"]))))
    moved = {n: np.roll(parts[n], -count, axis=0) for n in ("cmd_rate", "throttle", "cmd_thrust")}
    return {**parts, **moved}


def _held(parts: Parts, _: Vehicle) -> Parts:
    """Commands at two thirds of the policy's rate: 20 instead of 30 Hz."""
    step = float(np.median(np.diff(parts["time"])))
    first = np.floor(parts["time"] * 20.0 + 1e-6) / 20.0
    index = np.clip(np.round((first - parts["time"][0]) / step).astype(int), 0, None)
    return {**parts, **{n: parts[n][index] for n in ("cmd_rate", "throttle", "cmd_thrust")}}


def _late(parts: Parts, _: Vehicle) -> Parts:
    count = round(0.06 / float(np.median(np.diff(parts["time"]))))
    kept = {n: v[count:] for n, v in parts.items() if n not in ("pos", "vel", "quat")}
    return {**kept, **{n: parts[n][:-count] for n in ("pos", "vel", "quat")}}


def _drifting(parts: Parts, _: Vehicle) -> Parts:
    """The pose's clock runs 0.5 % fast."""
    time_s = parts["time"]
    at = time_s - 0.005 * (time_s - time_s.mean())
    moved = {
        n: np.stack([np.interp(at, time_s, c) for c in parts[n].T], axis=1)
        for n in ("pos", "vel", "quat")
        if n in parts
    }
    moved["quat"] /= np.linalg.norm(moved["quat"], axis=1, keepdims=True)
    return {**parts, **moved}


def _sunk(parts: Parts, _: Vehicle) -> Parts:
    """Two seconds on the ground; then the barometer falls by 1.6 m as the motors start."""
    step = float(np.median(np.diff(parts["time"])))
    count = round(2.0 / step)
    still = {n: np.repeat(v[:1], count, axis=0) for n, v in parts.items() if n != "time"}
    for name in ("motor", "throttle", "cmd_thrust", "vel", "rate", "cmd_rate"):
        still[name] = 0.0 * still[name]
    joined = {n: np.concatenate([v, parts[n]]) for n, v in still.items()}
    joined["time"] = parts["time"][0] + step * np.arange(count + len(parts["time"]))
    joined["baro"][count:] -= 1.6
    return joined


def _rotors(vehicle: Vehicle, **changes: object) -> Vehicle:
    return replace(vehicle, rotors=replace(vehicle.rotors, **changes))


def _in_mm(vehicle: Vehicle) -> Vehicle:
    hubs = tuple(tuple(1000.0 * c for c in hub) for hub in vehicle.rotors.position)
    return _rotors(vehicle, position=hubs)


ALL_FRD = tuple(f"{name}=x,-y,-z" for name in ("rate", "acc", "cmd_rate"))
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
        ("accelerometer_gravity",), change=_without_gravity, of=("acc", "quat")
    ),
    "accelerometer's bias with throttle": Kind(
        ("accelerometer_throttle_bias",),
        change=_biased_by_throttle,
        race=True,
        of=("acc", "throttle", "pos", "quat"),
    ),
    "position in mm": Kind(("position_unit",), ("pos=1000",)),
    "position in cm": Kind(("position_unit",), ("pos=100",)),
    "position north-east-down": Kind(("world_frame",), ("pos=x,-y,-z",)),
    "position's y inverted": Kind(("position_axes",), ("pos=x,-y,z",)),
    "velocity north-east-down": Kind(("velocity_frame",), ("vel=x,-y,-z",)),
    "velocity in body axes": Kind(("velocity_frame",), ("vel=from-world",)),
    "velocity turned twice": Kind(("velocity_frame",), ("vel=from-body",)),
    "velocity in cm/s": Kind(("velocity_unit",), ("vel=100",)),
    "all of it north-east-down": Kind(
        ("world_frame",), ("quat=ned+frd", "pos=x,-y,-z", "vel=x,-y,-z", *ALL_FRD)
    ),
    "body forward-right-down": Kind(("body_frame",), ("quat=frd", *ALL_FRD)),
    "quaternion xyzw": Kind(("quaternion_order",), ("quat=xyzw+xyzw+xyzw",)),
    "quaternion world to body": Kind(("quaternion_direction",), ("quat=inverse",)),
    "attitude's pitch and odometry's roll inverted": Kind(
        ("attitude_sign",), ("quat=-pitch", "rate=-x,y,z"), race=True
    ),
    "pose late by 60 ms": Kind(("clock_offset",), change=_late, of=("quat", "vel", "rate")),
    "pose's clock off by 0.5 %": Kind(("clock_drift",), change=_drifting, of=("quat", "rate")),
    "rotor speeds in rpm": Kind(("motor_unit",), (f"motor={RPM}",)),
    "electrical rotor speeds": Kind(("motor_unit",), ("motor=7",)),
    "12 poles declared of 14": Kind(("motor_poles",), (f"motor={14.0 / 12.0}",)),
    "motors in the order 2, 1, 4, 3": Kind(("motor_order",), ("motor=2,1,4,3",), drive=True),
    "motors in the order 4, 1, 2, 3": Kind(("motor_order",), ("motor=4,1,2,3",), drive=True),
    "motors 3 and 4 swapped": Kind(("motor_order",), ("motor=1,2,4,3",), drive=True),
    "motor 3 never turns": Kind(("motor_dead",), change=_dead, of=("motor",), drive=True),
    "spin of all motors": Kind(
        ("motor_spin",),
        vehicle=lambda v: _rotors(v, spin=tuple(-s for s in v.rotors.spin)),
        of=("motor", "rate"),
        drive=True,
    ),
    "thrust command in g": Kind(
        ("thrust_command_unit",), (f"cmd_thrust={1.0 / GRAVITY}",), of=("quat", "pos")
    ),
    "thrust command in newtons": Kind(
        ("thrust_command_unit",), of=("cmd_thrust", "quat", "pos"), change=_newtons
    ),
    "thrust command with down positive": Kind(
        ("thrust_command_unit",), ("cmd_thrust=-1",), of=("quat", "pos")
    ),
    "throttle from 0 to 1000": Kind(("throttle_range",), ("throttle=1000",)),
    "throttle in percent": Kind(("throttle_range",), ("throttle=100",)),
    "rate command in deg/s": Kind(("rate_command_unit",), (f"cmd_rate={DEG}",)),
    "sign of the yaw command": Kind(("rate_command_sign",), ("cmd_rate=x,y,-z",)),
    "linear stick map against a rates curve": Kind(
        ("rate_curve",), change=_curved, race=True, of=("cmd_rate", "rate")
    ),
    "commands act 150 ms later": Kind(
        ("command_delay",), change=_ahead, of=("cmd_rate", "rate", "throttle")
    ),
    "loop at two thirds of its rate (40 of 60 Hz)": Kind(
        ("controller_rate",), change=_held, race=True, of=("cmd_rate", "throttle")
    ),
    "time in ms": Kind(("time_unit",), change=lambda p, _: {**p, "time": 1e3 * p["time"]}),
    "voltage in mV": Kind(("voltage",), ("voltage=1000",)),
    "battery of 0.1 V": Kind(("voltage",), ("voltage=0.00625",)),
    "mass on five links": Kind(
        ("vehicle_mass", "vehicle_thrust"),
        vehicle=lambda v: replace(v, mass=5.0 * v.mass),
        race=True,
        of=("motor",),
    ),
    "arms in mm": Kind(("vehicle_arms",), vehicle=_in_mm),
    "speed_max in rpm": Kind(
        ("vehicle_thrust",), vehicle=lambda v: _rotors(v, speed_max=RPM * v.rotors.speed_max)
    ),
    "inertia x 1000": Kind(
        ("vehicle_inertia",),
        vehicle=lambda v: replace(v, inertia=tuple(1000.0 * j for j in v.inertia)),
    ),
    "barometer falls on spin-up": Kind(
        ("barometer_spin_up",), change=_sunk, race=True, of=("baro", "motor", "throttle")
    ),
    "field of view": Kind(("camera_fov",), fov=1.25, race=True),
    "thrust -10 %": Kind(
        ("thrust_scale",),
        race=True,
        vehicle=lambda v: _rotors(v, thrust_coefficient=v.rotors.thrust_coefficient / 0.9),
        of=("motor", "pos", "quat"),
    ),
}
"""Kind -> its change and the names under which it must be reported."""
