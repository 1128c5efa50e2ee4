"""Checks of a vehicle file for implausible parameters, of a policy's camera, and of mixed logs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eval.effects.interface import GRAVITY
from eval.logs.faults.finding import Finding
from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from tracks.geometry.camera import Camera
from tracks.input.ranges import is_number

ARM_M = (0.012, 1.5)
"""Usual distance from the centre to a rotor [m]."""
LIFT = (1.15, 20.0)
"""Usual ratio of full thrust to weight."""
ROUND = (0.015, 1.0)
"""Usual inertia about x and y over mass times arm squared: small where the mass is near the centre,
1 at most where no mass is beyond the rotors."""
TORQUE_M = (0.002, 0.1)
"""Plausible ratio of a rotor's torque to its thrust [m]; usual are 0.005 to 0.05."""
GAIN = 1.0
"""Smallest plausible gain of the nominal rate loop [1/s]."""
GAIN_LAG = 5.0
"""Largest plausible gain of the nominal rate loop times the time constant of the rotors: above, the
rates oscillate."""
GAINS = {
    "betaflight": ("p_roll", "p_pitch"),
    "px4": ("MC_ROLLRATE_P", "MC_PITCHRATE_P"),
    "crazyflie": ("roll_kp", "pitch_kp"),
}
"""Kind of a firmware's rate loop -> its P gains about roll and pitch."""
BODY_M, BODY_PER_ARM = 1.5, (0.1, 3.0)
"""Largest usual half size of the body [m], and its usual ratio to the arm."""
RATE_MOST = 50.0
"""Largest plausible limit of a body rate [rad/s], 2900 deg/s; racers have up to 35."""
FOV_LEAST_DEG = 10.0
"""If both fields of view are smaller than this [deg], they are probably in radians."""
MOTOR_PER_ROTOR = (0.2, 5.0)
"""Usual ratio of a motor's thrust at full command by `[motors]` to that of `[rotors]`."""
FIRMWARE_GAIN = 0.05
"""A firmware's P gain below this share of its default is probably in another unit."""
UNSURE = 0.85
"""Confidence of doubts about keys that only simulated flights use: they stop no diagnosis."""
LOOP = "rate loop"
"""Subject of findings on the settings of the firmware's rate loop."""
MOST_SETTINGS = 3
"""Largest number of differing settings that a finding's evidence lists."""
CAMERA_DEG = 2.0
"""Fields of view and pitches that differ by at most this belong to the same camera [deg]."""


def has_unusual_arms(vehicle: Vehicle) -> bool:
    """Return whether the rotors are at no usual distance from the middle."""
    return not ARM_M[0] <= _arm_m(vehicle) <= ARM_M[1]


def _arm_m(vehicle: Vehicle) -> float:
    hubs = np.asarray(vehicle.rotors.position)
    return float(np.mean(np.hypot(hubs[:, 0], hubs[:, 1])))


def check_vehicle_numbers(vehicle: Vehicle) -> list[Finding]:
    """Return findings on implausible arms, thrust, inertia, torque, gains, body and camera."""
    found, arm = [], _arm_m(vehicle)
    if has_unusual_arms(vehicle):
        text = f"rotors are {arm:.3g} m from the middle; usual are {ARM_M[0]:g} to {ARM_M[1]:g}"
        # Positions in cm or mm: prefer the unit by which the inertia is usual as well.
        units = [k for k in (100, 1000) if ARM_M[0] <= arm / k <= ARM_M[1]]
        units = [k for k in units if _is_round(_gyration(vehicle, arm / k))] or units
        divisors = " or ".join(map(str, units))
        fix = "rotors.position in m" + (f": divide by {divisors}" if units else "")
        found.append(Finding("doubt", "vehicle", text, "vehicle_arms", arm, 0.97, fix))
        # The wrong arm would make the inertia below unusual too: one finding is enough.
        arm = arm / units[0] if units else arm
    lift = vehicle.full_thrust / GRAVITY
    if not LIFT[0] <= lift <= LIFT[1]:
        text = f"full thrust is {lift:.3g} times the weight; usual are {LIFT[0]:g} to {LIFT[1]:g}"
        rpm = lift / (60.0 / (2.0 * np.pi)) ** 2
        fix = "rotors.speed_max in rad/s" + (", not rpm" if LIFT[0] <= rpm <= LIFT[1] else "")
        found.append(Finding("doubt", "vehicle", text, "vehicle_thrust", lift, 0.95, fix))
    gyration = _gyration(vehicle, arm)
    if not _is_round(gyration):
        text = (
            f"inertia about x or y is {gyration:.3g} times mass x arm^2; from {ROUND[0]:g} to "
            f"{ROUND[1]:g} is usual"
        )
        fix = "inertia in kg m^2, of this vehicle, or rotors.position in m"
        found.append(Finding("doubt", "vehicle", text, "vehicle_inertia", gyration, 0.93, fix))
    torque = vehicle.rotors.torque_coefficient
    ratio_m = torque / vehicle.rotors.thrust_coefficient
    if not TORQUE_M[0] <= ratio_m <= TORQUE_M[1]:
        text = f"torque_coefficient / thrust_coefficient is {ratio_m:.3g} m; usual are "
        fix = "rotors.torque_coefficient in N m/(rad/s)^2"
        if TORQUE_M[0] <= torque <= TORQUE_M[1]:
            fix = "PX4's KM is this ratio: torque_coefficient = KM * thrust_coefficient"
        about = ("vehicle_torque", ratio_m, 0.95, fix)
        found.append(Finding("doubt", "vehicle", text + "0.005 to 0.05 m", *about))
    controller, gains = vehicle.controller, vehicle.controller.rate_gain
    too_fast = max(gains) * vehicle.rotors.time_constant > GAIN_LAG
    too_fast = too_fast or controller.overshoots(1.0 / controller.frequency)
    if controller.kind == "p" and (too_fast or not min(gains) >= GAIN):
        gain = max(gains) if too_fast else min(gains)
        text = f"controller.rate_gain has {gain:.3g} 1/s; usual are 5 to 40 1/s"
        fix = (
            "gains are 1/s: angular acceleration for each rad/s of rate error; a firmware's PID "
            "gains have other units (docs/measure.md)"
        )
        # Only rollouts by rate commands use the gains, so they do not stop a diagnosis.
        found.append(Finding("note", "vehicle", text, "vehicle_gain", gain, 0.95, fix))
    found += _of_simulation(vehicle, arm)
    return found or [Finding("ok", "vehicle", f"full thrust is {lift:.3g} times the weight")]


def narrow_view(fov_deg: Sequence[float]) -> str:
    """Return what is doubtful if a camera's field of view [deg] is tiny, and "" otherwise."""
    if max(fov_deg) >= FOV_LEAST_DEG:
        return ""
    return f"its camera sees only {fov_deg[0]:g} x {fov_deg[1]:g} deg"


def vehicle_doubts(vehicle: Vehicle) -> list[str]:
    """Return the doubts of `check_vehicle_numbers` as sentences with their fixes."""
    return [
        f"vehicle {vehicle.name!r}: {finding.evidence}; {finding.fix}"
        for finding in check_vehicle_numbers(vehicle)
        if finding.status != "ok"
    ]


def _of_simulation(vehicle: Vehicle, arm: float) -> list[Finding]:
    """Return findings on body, limits, camera, motors and firmware gains; `arm` is in m."""
    found = []
    size = max(vehicle.body.half_size)
    if size > BODY_M:
        text = f"the body reaches {size:.3g} m from the centre; usual are at most {BODY_M:g}"
        low, high = BODY_PER_ARM
        units = [str(k) for k in (100, 1000) if low <= size / k / arm <= high]
        fix = "body.half_size in m" + (f": divide by {' or '.join(units)}" if units else "")
        found.append(Finding("doubt", "vehicle", text, "vehicle_arms", size, UNSURE, fix))
    if (fastest := max(vehicle.controller.rate_max)) > RATE_MOST:
        text = f"controller.rate_max is {fastest:g} rad/s, {np.rad2deg(fastest):.0f} deg/s"
        fix = "controller.rate_max in rad/s, not deg/s"
        found.append(Finding("doubt", "vehicle", text, "vehicle_gain", fastest, UNSURE, fix))
    fov_deg = vehicle.camera.fov_deg
    if text := narrow_view(fov_deg):
        fix = "camera.fov_deg in degrees, not radians"
        found.append(Finding("doubt", "vehicle", text, "camera_fov", None, UNSURE, fix))
    if vehicle.motors is not None:
        full, rotor = sum(vehicle.motors.thrust), vehicle.rotors.thrust_max
        if not MOTOR_PER_ROTOR[0] <= full / rotor <= MOTOR_PER_ROTOR[1]:
            text = f"a motor gives {full:.3g} N by [motors], and a rotor {rotor:.3g} N by [rotors]"
            fix = "motors.thrust in N, of one motor at the full command 1"
            about = ("motor_map", full / rotor, UNSURE, fix)
            found.append(Finding("doubt", "vehicle", text, *about))
    if (settings := vehicle.controller.settings) is not None:
        usual = type(settings)()
        for key in GAINS.get(vehicle.controller.kind, ()):
            gain, default = getattr(settings, key), getattr(usual, key)
            if gain < FIRMWARE_GAIN * default:
                text = f"controller.{key} is {gain:.3g}; the firmware's default is {default:g}"
                fix = "gains as the firmware's own tool shows them"
                found.append(Finding("note", "vehicle", text, "vehicle_gain", gain, 0.95, fix))
                break
    return found


def _gyration(vehicle: Vehicle, arm: float) -> float:
    """Return the inertia about x or y over mass times `arm` [m] squared; the less usual of both."""
    ratios = [j / (vehicle.mass * arm**2) for j in vehicle.inertia[:2]]
    return max(ratios, key=lambda r: abs(np.log(r / np.sqrt(ROUND[0] * ROUND[1]))))


def _is_round(gyration: float) -> bool:
    """Return whether such a ratio of `_gyration` is usual."""
    return ROUND[0] <= gyration <= ROUND[1]


def check_camera(policy: Camera | None, vehicle: Vehicle | None) -> list[Finding]:
    """Return a finding on whether the camera of a policy agrees with that of the vehicle."""
    if policy is None or vehicle is None:
        return []
    seen, here = ((*camera.fov_deg, camera.pitch_deg) for camera in (policy, vehicle.camera))
    text = "{:g} x {:g} deg, pitched up by {:g} deg"
    figures = f"the policy's camera sees {text.format(*seen)}, the vehicle's {text.format(*here)}"
    if max(abs(a - b) for a, b in zip(seen, here, strict=True)) <= CAMERA_DEG:
        return [Finding("ok", "camera", figures)]
    fix = "camera.* of the vehicle file, or crop the image, or turn the camera"
    return [Finding("doubt", "camera", figures, "camera_fov", here[0] / seen[0], 0.97, fix)]


def check_vehicle_name(about: Mapping[str, Any], vehicle: Vehicle | None) -> list[Finding]:
    """Return a note where a log's metadata `about` name another vehicle than the given one."""
    name = about.get("vehicle")
    if vehicle is None or not name or str(name) == vehicle.name:
        return []
    text = f"the log names the vehicle {str(name)!r}, and --vehicle is {vehicle.name!r}"
    return [Finding("note", "vehicle", text)]


def check_controller(about: Mapping[str, Any], vehicle: Vehicle | None) -> list[Finding]:
    """Return a finding where a log's metadata `about` have the settings of a firmware's rate loop.

    They are the entry `controller`: the kind of the loop, and its settings by name, as in the
    vehicle file. Settings that the vehicle file's loop does not have are ignored.
    """
    logged = about.get("controller")
    if vehicle is None or not isinstance(logged, Mapping):
        return []
    kind, here = logged.get("kind"), vehicle.controller
    if kind != here.kind:
        text = f"the log's is of kind {kind!r}, that of the vehicle file of kind {here.kind!r}"
        return [Finding("note", LOOP, text)]
    known = vars(here.settings) if here.settings else {}
    pairs = {
        name: (float(value), float(known[name]))
        for name, value in logged.items()
        if name in known and is_number(value)
    }
    if not pairs:
        return []
    other = {name: pair for name, pair in pairs.items() if not np.isclose(*pair, rtol=1e-4, atol=0)}
    if not other:
        text = f"{len(pairs)} settings of the log are those of the vehicle file"
        return [Finding("ok", LOOP, text)]
    texts = [
        f"{name} is {there:g}, in the vehicle file {own:g}" for name, (there, own) in other.items()
    ]
    text = "; ".join(texts[:MOST_SETTINGS])
    if len(texts) > MOST_SETTINGS:
        text += f"; and {len(texts) - MOST_SETTINGS} more"
    fix = ", ".join(f"{name} = {there:g}" for name, (there, _) in other.items())
    fix = f"{fix} in [controller] of the vehicle file"
    return [Finding("doubt", LOOP, text, "controller_settings", None, UNSURE, fix)]


def check_same_vehicle(logs: Sequence[FlightLog]) -> list[tuple[Finding, str]]:
    """Return a finding, with the log's name, on each log of another vehicle than most others.

    Only names in the metadata (`vehicle`) are compared; a log without one is not checked.
    """
    named = [(log.name, str(log.about["vehicle"])) for log in logs if log.about.get("vehicle")]
    found = []
    for usual, count in Counter(vehicle for _, vehicle in named).most_common(1):
        for name, vehicle in named:
            if vehicle != usual:
                text = f"is of vehicle {vehicle!r}; {count} of {len(named)} logs are of {usual!r}"
                fix = "give only the logs of one vehicle, imported with one --vehicle"
                finding = Finding("doubt", "log", text, "vehicle_mixed", None, 0.95, fix)
                found.append((finding, name))
    return found
