"""What logs do not identify is reported with the column that it would need."""

from dataclasses import replace

import numpy as np
import pytest

from eval.vehicles.vehicle import MotorMap
from suite.diagnose.identify.fit import Fitted, Unknown
from suite.diagnose.identify.grid import STEP_S, FlightGrid
from suite.diagnose.identify.numbers import DELAY, Number, not_attempted, not_identified, notes_on
from tests.support.vehicles import PLAIN


def flight(*signals):
    return FlightGrid("made", STEP_S * np.arange(10), dict.fromkeys(signals, np.zeros(10)))


def found(*names, left=()):
    unknowns = tuple(Unknown(name, 0.0, -1.0, 1.0, 1.0, 0.1) for name in names)
    none = np.zeros(len(names))
    return Fitted(unknowns, none, none, np.diag(none), tuple(left))


def test_what_one_fit_leaves_and_another_identifies_is_identified():
    fitted = {"torque": found("lag", "late", left=["lag", "late"]), "loop": found("lag")}
    entries = {DELAY: Number(DELAY, "s", [0.0], [None])}
    assert [line.split(":")[0] for line in not_identified(fitted, entries)] == ["command_delay"]


def test_the_sum_of_lag_and_delay_is_reported_where_neither_is_identified():
    fitted = {"torque": found("late", "lag", left=["lag"])}
    fitted["torque"].value[:] = [0.042, 0.03]
    lines = not_identified(fitted, {DELAY: Number(DELAY, "s", [0.012], [None], True)})
    assert lines[-1] == (
        "command_delay: only its sum with the rotors' lag, 0.042 s; the file's delay, 0.012 s, is "
        "this sum minus the file's lag"
    )
    (line,) = not_identified(fitted, {DELAY: Number(DELAY, "s", [0.012], [(0.01, 0.014)])})
    assert line.startswith("time_constant")


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
         ["time_constant and command_delay: measured rotor speeds do not contain"]),
        ("torques", ["torque_cmd_b"], FORCE | TORQUE, [], ["rate_gain: these logs"]),
        ("pwm", ["pwm", "voltage"], FORCE | TORQUE | {"loop": found("gain_x")}, [], []),
    ],
)  # fmt: skip
def test_what_has_no_column_is_reported(drive, signals, fitted, leave, words):
    lines = not_attempted([flight(*signals)], PLAIN, drive, fitted, leave)
    assert len(lines) == len(words)
    for line, word in zip(lines, words, strict=True):
        assert line.startswith(word)


def test_a_firmwares_loop_is_not_fitted():
    loop = replace(PLAIN, controller=replace(PLAIN.controller, kind="px4"))
    (line,) = not_attempted([flight("pwm", "voltage")], loop, "pwm", FORCE | TORQUE, [])
    assert line == "the rate loop: settings of a px4 loop are not fitted"


BOTH = "these logs have no stretch with both"


@pytest.mark.parametrize(
    ("drive", "fitted", "broken", "words"),
    [
        ("pwm", {}, ["force", "torque"], ["thrust and drag", "inertia and torque_coefficient",
                                          "time_constant and command_delay"]),
        ("rotors", FORCE | {"torque": found("inertia_x")}, ["rotors"],
         ["time_constant and command_delay"]),
        ("rates", FORCE | TORQUE, ["loop"], ["rate_gain"]),
    ],
)  # fmt: skip
def test_columns_that_never_go_on_together_are_reported(drive, fitted, broken, words):
    leave = [] if "loop" in broken else ["loop"]
    signals = ["pwm", "voltage", "rotor_speed", "rate_b", "rate_cmd_b"]
    lines = not_attempted([flight(*signals)], PLAIN, drive, fitted, leave, broken)
    assert [line.split(f": {BOTH}")[0] for line in lines] == words


@pytest.mark.parametrize(
    ("exponent", "end"),
    [(0.0, "so the voltage has no effect"), (1.2, "assumed to be that at 16 V")],
)
def test_without_a_voltage_the_one_that_counts_is_reported(exponent, end):
    vehicle = replace(PLAIN, motors=MotorMap((1.0, 4.0), 16.0, exponent))
    (line,) = not_attempted([flight("pwm")], vehicle, "pwm", FORCE | TORQUE, ["loop"])
    assert line.startswith("voltage_exponent: these logs have no voltage") and line.endswith(end)


def test_what_was_done_with_the_flights_is_reported():
    turns = flight("rotor_speed", "voltage")._replace(in_turn=("rotor_speed",))
    after = replace(
        PLAIN,
        motors=MotorMap((1.0, 4.0), 15.2),
        rotors=replace(PLAIN.rotors, speed_max=2500.0),
    )
    words = ["made: no row has all columns of rotor_speed", "no voltage in a, b: these flights",
             "motors.voltage = 15.2 V, the median", "rotors.speed_max = 2500 rad/s"]  # fmt: skip
    lines = notes_on([turns], {"b", "a"}, PLAIN, after)
    assert len(lines) == len(words)
    for line, word in zip(lines, words, strict=True):
        assert line.startswith(word)
    assert notes_on([flight("rotor_speed")], (), after, after) == []
