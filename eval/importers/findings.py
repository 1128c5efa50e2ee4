"""Which quantities a partial log allows to estimate."""

from __future__ import annotations

import numpy as np

from eval.logs.faults.finding import Finding

TEXTS = {"pos": "position", "quat": "attitude", "rate": "body rates", "command": "commands"}
_ROTORS = ("motor", "pwm")
QUESTIONS = (
    ("the force on the body (thrust, mass, drag)", ("pos", "quat"), (*_ROTORS, "cmd_thrust")),
    ("its torque (inertia, rotors, centre of mass)", ("rate",), (*_ROTORS, "cmd_torque")),
    ("the weight and the balance of the rotors in hover", ("pos",), (*_ROTORS, "cmd_torque")),
    ("the vertical force in slow flight (thrust, mass)", ("pos",), (*_ROTORS, "cmd_thrust")),
    (
        "thrust by the accelerometer (thrust over mass, battery sag, weak motor)",
        ("acc", "rate"),
        (*_ROTORS, "cmd_thrust"),
    ),
    ("the rate loop (gains, delay)", ("rate", "cmd_rate"), ("rate",)),
    ("the rotors' lag", ("motor",), ("pwm", "motor_cmd")),
)
"""Quantity, required signals, and alternative signals of which one is required."""
UNSEEN = {
    "pos": ("the path", "wind", "faults of position and velocity"),
    "quat": ("faults of the attitude", "the gyro's scale and axes against it"),
    "acc": ("thrust over mass", "drag"),
}
"""Signal -> quantities that are not identifiable without it and without a pose."""


def usable_for(rows: dict[str, np.ndarray], lacks: list[str]) -> Finding:
    """Return the finding that lists what a log without the groups `lacks` is usable for."""
    no_pose = "pos" in lacks and "quat" in lacks
    can = [
        question
        for question, needs, driven_by in QUESTIONS
        if all(name in rows for name in needs) and any(name in rows for name in driven_by)
    ]
    without = " and no ".join(TEXTS[name] for name in lacks)
    text = f"no {without}; what can be asked of it: {'; '.join(can) or 'nothing but its path'}"
    if no_pose:
        text = f"this log has no pose: {text}; not identifiable from it: "
        text += ", ".join(
            what for name, whats in UNSEEN.items() if name not in rows for what in whats
        )
    return Finding("note", "partial", text)
