"""What an import has to say about a log: checks, corrections, doubts, and what can be asked."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Finding(NamedTuple):
    """One statement about an imported log."""

    level: str
    """`ok` (checked and as it should be), `note` (worth knowing), `corrected` (found wrong and put
    right), `doubt` (looks wrong, left as it is)."""
    subject: str
    """What it is about: `time`, `attitude`, `velocity`, `thrust`, ..."""
    text: str
    """One sentence with the figures that it rests on."""


def said(findings: tuple[Finding, ...]) -> list[str]:
    """Return the findings as lines for people, the serious ones first."""
    order = ("corrected", "doubt", "note", "ok")
    ranked = sorted(findings, key=lambda finding: order.index(finding.level))
    return [f"{finding.level:9} {finding.subject}: {finding.text}" for finding in ranked]


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
