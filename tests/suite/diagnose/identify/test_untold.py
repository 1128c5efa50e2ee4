"""What logs cannot tell is said with the column that it would need."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.identify.data.grid import STEP_S, FlightGrid
from suite.diagnose.identify.fit import Fitted, Unknown
from suite.diagnose.identify.untold import unasked, untold
from tests.support.vehicles import PLAIN


def flight(*signals):
    return FlightGrid("made", STEP_S * np.arange(10), dict.fromkeys(signals, np.zeros(10)))


def found(*names, left=()):
    unknowns = tuple(Unknown(name, 0.0, -1.0, 1.0, 1.0, 0.1) for name in names)
    none = np.zeros(len(names))
    return Fitted(unknowns, none, none, np.diag(none), tuple(left))


def test_what_one_fit_leaves_and_another_tells_is_told():
    fitted = {"torque": found("lag", "late", left=["lag", "late"]), "loop": found("lag")}
    assert [line.split(":")[0] for line in untold(fitted)] == ["command_delay"]


FORCE = {"force": found("thrust", "drag_x", "drag_y", "drag_z")}
TORQUE = {"torque": found("inertia_x", "late", "lag")}


@pytest.mark.parametrize(
    ("drive", "signals", "fitted", "leave", "words"),
    [
        ("pwm", ["pwm"], {}, [], ["thrust and drag: these logs have no", "voltage_exponent",
                                  "inertia", "time_constant", "rate_gain"]),
        ("pwm", ["pwm", "voltage"], {"force": found("thrust", "drag_z")}, ["loop", "inertia",
                                                                         "lag"],
         ["drag along body x and y: without an attitude"]),
        ("rates", ["thrust_cmd"], FORCE | {"loop": found("gain_x", "late", "lag")}, [],
         ["inertia and torque_coefficient: commanded rates"]),
        ("rotors", ["rotor_speed"], FORCE | {"torque": found("inertia_x")}, ["loop"],
         ["time_constant and command_delay: measured rotor speeds are past"]),
        ("torques", ["torque_cmd_b"], FORCE | TORQUE, [], ["rate_gain: these logs"]),
        ("pwm", ["pwm", "voltage"], FORCE | TORQUE | {"loop": found("gain_x")}, [], []),
    ],
)  # fmt: skip
def test_what_has_no_column_is_said(drive, signals, fitted, leave, words):
    lines = unasked([flight(*signals)], PLAIN, drive, fitted, leave)
    assert len(lines) == len(words)
    for line, word in zip(lines, words, strict=True):
        assert line.startswith(word)


def test_a_firmwares_loop_is_not_fitted():
    loop = replace(PLAIN, controller=replace(PLAIN.controller, kind="px4"))
    (line,) = unasked([flight("pwm", "voltage")], loop, "pwm", FORCE | TORQUE, [])
    assert line == "the rate loop: settings of a px4 loop are not fitted"
