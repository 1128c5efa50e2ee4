"""What can be asked of a log that lacks something."""

from __future__ import annotations

import numpy as np

from eval.logs.faults.finding import Finding

TEXTS = {"pos": "position", "quat": "attitude", "rate": "body rates", "command": "commands"}
QUESTIONS = (
    ("the force on the body (thrust, mass, drag)", ("pos", "quat"), ("motor", "pwm", "cmd_thrust")),
    ("its torque (inertia, rotors, centre of mass)", ("rate",), ("motor", "pwm", "cmd_torque")),
    ("the weight and the balance of the rotors in hover", ("pos",), ("motor", "pwm", "cmd_torque")),
    ("the vertical force in slow flight (thrust, mass)", ("pos",), ("motor", "pwm", "cmd_thrust")),
)
"""What can be asked, what it needs, and of which one of these it is driven."""


def asked_of(rows: dict[str, np.ndarray], lacks: list[str]) -> Finding:
    """Return what a log without the groups `lacks` can be asked."""
    can = [
        question
        for question, needs, driven_by in QUESTIONS
        if all(name in rows for name in needs) and any(name in rows for name in driven_by)
    ]
    without = " and no ".join(TEXTS[name] for name in lacks)
    text = f"no {without}; what can be asked of it: {'; '.join(can) or 'nothing but its path'}"
    return Finding("note", "partial", text)
