"""Logs and mappings with one mistake: corrected exactly, or refused by name before a diagnosis.

A PX4-like table, north-east-down and forward-right-down, with measurement noise. Each case flies
with and without rotor speeds and a pose, where the mistake can then be made at all.
"""

from dataclasses import replace
from functools import reduce

import numpy as np
import pytest

from eval.importers import import_log
from eval.logs.faults.check import CheckContext
from eval.logs.faults.checked import check_flights
from suite.experiments.injected.flights import flight_signals
from suite.experiments.injected.kinds import KINDS, inject
from suite.experiments.injected.writers import write_table
from tests.support import known_flight
from tests.support.vehicles import PLAIN

pytestmark = pytest.mark.slow
ROTORS, POSE = ("motor", "pwm"), ("pos", "quat", "vel")
ALL = (*POSE, *ROTORS, "rate", "acc", "cmd_rate", "throttle")
LACKS = {
    "whole": (),
    "no rotor speeds": ROTORS,
    "no pose": POSE,
    "no pose and no rotor speeds": (*POSE, *ROTORS),
}
COMPARED = ("pos_w", "vel_w", "quat_wxyz", "rate_b", "acc_b", "rotor_speed", "thrust_cmd",
            "rate_cmd_b")  # fmt: skip
SIGNALS = (
    ("gyro in raw counts (x16.384)",), ("gyro in rad/s, taken for deg/s",),
    ("gyro 20 % too large",), ("motors in the order 2, 1, 4, 3",),
    ("motors in the order 4, 1, 2, 3",), ("motors 3 and 4 swapped",),
    ("12 poles declared of 14",), ("sign of the yaw command",), ("throttle from 0 to 1000",),
    ("position in cm", "velocity in cm/s"), ("position in cm",),
)  # fmt: skip
"""Kinds of faults that are injected at once."""
ALSO = {"gyro 20 % too large": "rate_curve"}
"""Kind -> another name that is right for it."""
MAPPINGS = {
    "z-up declared, north-east-down": ('world = "ned"', 'world = "z-up"', "pos", "world_frame"),
    "FLU declared, forward-right-down": (
        'body = "frd"', 'body = "flu"', "", "body_frame accelerometer_axes",
    ),
    "xyzw declared, wxyz": ("[quat]\n", '[quat]\norder = "xyzw"\n', "pos", "quaternion_order"),
}  # fmt: skip
"""Mistake -> text of the mapping, what stands there instead, the signal without which there is
none, and names of it."""
VEHICLES = {
    "arms in mm": "vehicle_arms",
    "speed_max in rpm": "vehicle_thrust",
    "inertia x 1000": "vehicle_inertia",
}


def imported(folder, lacks, change=lambda parts: parts, mapping=("", ""), vehicle=PLAIN):
    """Import such a flight; return its log and the findings."""
    parts = flight_signals(known_flight.log(16.0), PLAIN, np.random.default_rng(1))
    written = write_table(folder, change(parts))
    tables = written.options.map.read_text(encoding="utf-8").replace(*mapping).split("\n[")
    text = "\n[".join(t for t in tables if t.split("]")[0] not in lacks)
    written.options.map.write_text(text, encoding="utf-8")
    options = replace(written.options, vehicle=vehicle, partial=bool(lacks))
    return import_log(written.path, "table", options)


def same(one, other):
    """Whether two imports hold the same flight."""
    for name in COMPARED:
        a, b = getattr(one, name), getattr(other, name)
        if name == "quat_wxyz":
            a, b = a * np.sign(a[:, :1]), b * np.sign(b[:, :1])
        if (a is None) != (b is None) or (
            a is not None and not np.allclose(a, b, rtol=1e-3, atol=1e-3, equal_nan=True)
        ):
            return False
    return True


def refused_by(log, vehicle=PLAIN):
    """The faults for which a diagnosis refuses a log."""
    try:
        check_flights([log], CheckContext(vehicle))
    except ValueError as error:
        return set(str(error).splitlines()[-1].partition("--accept ")[2].split())
    return set()


@pytest.mark.parametrize("lacks", LACKS)
@pytest.mark.parametrize("mistake", [*SIGNALS, *MAPPINGS])
def test_a_mistake_is_corrected_exactly_or_stops_a_diagnosis_by_its_name(tmp_path, mistake, lacks):
    if mistake in SIGNALS:
        kinds = [KINDS[name] for name in mistake]
        names = {name for kind in kinds for name in kind.names} | {ALSO.get(mistake[0], "")}
        there = all(kind.fits({*ALL} - {*LACKS[lacks]}) for kind in kinds)
        wrong = {"change": lambda parts: reduce(lambda p, k: inject(k, p, PLAIN), kinds, parts)}
    else:
        *mapping, signal, text = MAPPINGS[mistake]
        there, names, wrong = signal not in LACKS[lacks], {*text.split()}, {"mapping": mapping}
    if not there:
        pytest.skip("such a log does not hold the signal")
    log, findings = imported(tmp_path, LACKS[lacks], **wrong)
    good, _ = imported(tmp_path, LACKS[lacks])
    stops = refused_by(log)
    assert names & {f.fault for f in findings if f.status in ("corrected", "doubt")}
    assert stops <= names, "no wrong name"
    assert stops or same(log, good)


@pytest.mark.parametrize("lacks", LACKS)
@pytest.mark.parametrize("mistake", VEHICLES)
def test_a_wrong_vehicle_file_stops_a_diagnosis_by_its_name(tmp_path, mistake, lacks):
    vehicle = KINDS[mistake].vehicle(PLAIN)
    log, _ = imported(tmp_path, LACKS[lacks], vehicle=vehicle)
    assert refused_by(log, vehicle) == {VEHICLES[mistake]}


@pytest.mark.parametrize("lacks", LACKS)
def test_a_correct_log_is_accepted(tmp_path, lacks):
    log, findings = imported(tmp_path, LACKS[lacks])
    assert not refused_by(log)
    assert not [f for f in findings if f.fault and f.status in ("corrected", "doubt")]
