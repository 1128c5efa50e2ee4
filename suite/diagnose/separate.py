"""Which flight would tell two effects apart that look alike."""

from __future__ import annotations

ADVICE: dict[tuple[str, str], str] = {
    ("motor_lag", "command_delay"): "a fast thrust chirp, or a log with measured rotor speeds",
    ("rotor_drag", "linear_drag"): "changes of thrust at held speed",
    ("com_offset", "torque_trim"): "strong changes of collective thrust in hover",
    ("constant_wind", "frame_tilt"): "slow turns about the vertical at high speed",
    ("linear_drag", "quadratic_drag"): "straight flight over a threefold range of speeds",
    ("rotor_drag", "quadratic_drag"): "changes of thrust at held speed, over a range of speeds",
    ("battery_sag", "thrust_scale"): "a flight of a minute, or a log with the battery's voltage",
    ("mass_offset", "thrust_scale"): "no flight tells them well: weigh the vehicle",
    ("rate_gain", "inertia_scale"): "a log with measured rotor speeds",
    ("inflow", "linear_drag"): "climbs at different thrust: steep and level at the same speed",
    ("thrust_tilt", "frame_tilt"): "the same manoeuvre at several headings",
}
"""What makes the difference, by pair."""
OTHERWISE = "a faster flight with changes of thrust, speed, heading and height"


def advice(name: str, rival: str) -> str:
    """Return a sentence that says which flight would tell `name` from `rival`."""
    flight = ADVICE.get((name, rival)) or ADVICE.get((rival, name)) or OTHERWISE
    return f"{name} from {rival}: {flight}"
