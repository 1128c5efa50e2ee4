"""What goes wrong most in logs, late poses too, is found, and put right where that is allowed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eval.importers import import_log
from eval.importers.checks.attitude import READINGS, as_read, body_turns, check_attitude
from eval.importers.checks.delay import check_delay, delay_of
from eval.importers.checks.motion import check_frames, check_velocity
from eval.importers.checks.units import check_units
from eval.importers.frames import HALF_TURN
from eval.importers.options import ImportOptions
from eval.importers.signals import Recording, Signal
from tests.support import known_flight
from tests.support.imported import flight, of, write
from tests.support.known_flight import FLIP

FAULTS = {
    "xyzw": (lambda p: p | {"quat": p["quat"][:, [1, 2, 3, 0]]}, {"attitude"}),
    "inverse": (lambda p: p | {"quat": p["quat"] * [1, -1, -1, -1]}, {"attitude"}),
    "xyzw inverse": (
        lambda p: p | {"quat": (p["quat"] * [1, -1, -1, -1])[:, [1, 2, 3, 0]]},
        {"attitude"},
    ),
    "degrees": (lambda p: p | {"rate": np.rad2deg(p["rate"])}, {"units"}),
    "degrees, commands too": (
        lambda p: p | {"rate": np.rad2deg(p["rate"]), "cmd_rate": np.rad2deg(p["cmd_rate"])},
        {"units", "rate command"},
    ),
    "degrees, commands only": (
        lambda p: p | {"cmd_rate": np.rad2deg(p["cmd_rate"])},
        {"rate command"},
    ),
    "ms": (lambda p: p | {"time": p["time"] * 1e3}, {"units"}),
    "us": (lambda p: p | {"time": p["time"] * 1e6 + 5e9}, {"units"}),
    "ns": (lambda p: p | {"time": p["time"] * 1e9}, {"units"}),
    "us and degrees": (
        lambda p: p | {"time": p["time"] * 1e6, "rate": np.rad2deg(p["rate"])},
        {"units"},
    ),
    "velocity in the body": (
        lambda p: (
            p | {"vel": Rotation.from_quat(p["quat"], scalar_first=True).inv().apply(p["vel"])}
        ),
        {"velocity"},
    ),
    "velocity in NED": (lambda p: p | {"vel": p["vel"] @ FLIP}, {"velocity"}),
    "NED and FRD": (
        lambda p: (
            p
            | {name: p[name] @ FLIP for name in ("pos", "vel", "rate", "acc", "cmd_rate")}
            | {"quat": p["quat"] * [1, 1, -1, -1]}
        ),
        {"frames"},
    ),
    "NED positions": (lambda p: p | {name: p[name] @ FLIP for name in ("pos", "vel")}, {"frames"}),
    "FRD gyro": (
        lambda p: p | {name: p[name] @ FLIP for name in ("rate", "acc", "cmd_rate")},
        {"attitude"},
    ),
    "g": (lambda p: p | {"acc": p["acc"] / 9.81}, {"accelerometer"}),
    "gravity's sign": (lambda p: p | {"acc": -p["acc"]}, {"accelerometer"}),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_fault_is_found_and_put_right(tmp_path, fault, noise):
    change, subjects = FAULTS[fault]
    good = flight(noise=noise)
    path = write(tmp_path / "log.csv", change(good))
    log, findings = import_log(path)
    assert of(findings, "corrected") == subjects
    assert not of(findings, "doubt")
    wanted, _ = import_log(write(tmp_path / "good.csv", good))
    np.testing.assert_allclose(log.time_s, wanted.time_s, atol=1e-6)
    for name in ("pos_w", "vel_w", "rate_b", "acc_b", "rate_cmd_b"):
        np.testing.assert_allclose(getattr(log, name), getattr(wanted, name), atol=1e-6)
    alike = np.abs(np.sum(log.quat_wxyz * wanted.quat_wxyz, axis=1))
    np.testing.assert_allclose(alike, 1.0, atol=1e-9)


@pytest.mark.parametrize("fault", sorted(set(FAULTS) - {"ms", "us", "ns", "us and degrees"}))
def test_nothing_is_corrected_where_that_is_forbidden(tmp_path, fault):
    change, subjects = FAULTS[fault]
    parts = change(flight())
    path = write(tmp_path / "log.csv", parts)
    log, findings = import_log(path, None, ImportOptions(fix=False))
    assert not of(findings, "corrected") and of(findings, "doubt") & subjects
    np.testing.assert_allclose(log.rate_b, parts["rate"], atol=1e-12)
    np.testing.assert_allclose(log.vel_w, parts["vel"], atol=1e-12)
    np.testing.assert_allclose(log.quat_wxyz, parts["quat"], atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_a_good_log_stays_as_it_is(tmp_path, seed):
    good = flight(noise=2.0, seed=seed)
    log, findings = import_log(write(tmp_path / "log.csv", good))
    assert not of(findings, "corrected") and not of(findings, "doubt")
    assert of(findings, "ok") >= {"units", "attitude", "velocity", "frames", "accelerometer"}
    np.testing.assert_allclose(log.pos_w, good["pos"], atol=1e-12)


def test_a_calm_flight_is_not_judged(tmp_path):
    good = flight()
    t = good["time"]
    still = {
        "time": t,
        "pos": np.tile([0.0, 0.0, 1.0], (len(t), 1)),
        "quat": np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1)),
        "vel": np.zeros((len(t), 3)),
        "rate": np.zeros((len(t), 3)) + 1e-4,
        "cmd_thrust": np.full((len(t), 1), 9.81),
        "cmd_rate": np.zeros((len(t), 3)),
    }
    _, findings = import_log(write(tmp_path / "log.csv", still))
    assert of(findings, "note") >= {"units", "attitude", "velocity", "frames"}
    assert not of(findings, "corrected") and not of(findings, "doubt")


def test_an_attitude_that_fits_nothing_is_doubted(tmp_path):
    good = flight()
    wrong = good | {"rate": good["rate"][:, [1, 2, 0]]}
    _, findings = import_log(write(tmp_path / "log.csv", wrong))
    assert "attitude" in of(findings, "doubt")


def test_a_rate_command_of_the_wrong_sign_is_doubted(tmp_path):
    good = flight()
    wrong = good | {"cmd_rate": good["cmd_rate"] * [1, -1, 1]}
    _, findings = import_log(write(tmp_path / "log.csv", wrong))
    text = " ".join(finding.text for finding in findings if finding.level == "doubt")
    assert "about y" in text


def turning(rate_scale=1.0):
    """A recording of a body that turns about z at 1 rad/s."""
    time = np.arange(0, 4, 0.01)
    half = 0.5 * time
    quat = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)
    rate = np.tile([0.0, 0.0, rate_scale], (len(time), 1))
    signals = {"quat": Signal(time, quat), "rate": Signal(time, rate)}
    return Recording("log", signals)


def test_the_attitude_of_a_steady_turn_gives_the_gyros_rate():
    quat, rate = (turning().signals[name] for name in ("quat", "rate"))
    for found in body_turns(quat.time_s, quat.value, rate.value):
        assert len(found) > 300
        np.testing.assert_allclose(found, np.tile([0.0, 0.0, 1.0], (len(found), 1)), atol=1e-12)


def test_degrees_are_told_by_how_far_the_attitude_turns():
    given = turning(180 / np.pi)
    put_right, (finding,) = check_units(given, fix=True)
    np.testing.assert_allclose(put_right.signals["rate"].value[:, 2], 1.0, rtol=1e-12)
    assert (finding.level, finding.subject) == ("corrected", "units")
    assert "time is in s and rates are in deg/s" in finding.text
    same, (finding,) = check_units(given, fix=False)
    assert same is given and finding.level == "doubt" and "left as they are" in finding.text
    # Two hundred times too slow is no unit's doing.
    same, (finding,) = check_units(turning(1 / 200.0), fix=True)
    assert finding.level == "doubt" and "no mix-up of units explains" in finding.text


def test_a_velocity_in_centimetres_is_told_by_the_path():
    time = np.arange(0, 4, 0.01)
    vel = np.stack([np.cos(time), 2 + 0 * time, -np.sin(time)], axis=1)
    pos = np.stack([np.sin(time), 2 * time, np.cos(time)], axis=1)
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(time), 1))
    rows = {"time": time, "pos": pos, "vel": 100 * vel, "quat": level}
    (finding,) = check_velocity(rows, fix=True)
    assert finding.level == "corrected" and "in world axes and cm/s" in finding.text
    np.testing.assert_allclose(rows["vel"], vel, rtol=1e-12)


def test_commanded_torques_and_attitudes_turn_with_what_they_are_held_against():
    good = flight(noise=0.0)
    good |= {"cmd_quat": good["quat"], "cmd_torque": good["rate"]}
    body = {name: good[name] @ FLIP for name in ("rate", "acc", "cmd_rate", "cmd_torque")}
    turned = {name: good[name] * [1, 1, -1, -1] for name in ("quat", "cmd_quat")}
    rolled = {name: good[name][:, [1, 2, 3, 0]] for name in ("quat", "cmd_quat")}
    world = {name: good[name] @ FLIP for name in ("pos", "vel")}
    for check, rows in ((check_frames, good | body | turned | world),
                        (check_attitude, good | body | rolled)):  # fmt: skip
        assert [finding.level for finding in check(rows, True)] == ["corrected"]
        for name in ("cmd_torque", "cmd_quat", "quat", "rate"):
            np.testing.assert_allclose(rows[name], good[name], atol=1e-12)


def test_without_positions_units_are_told_by_the_attitude_alone():
    good = flight(noise=0.0)
    signals = {n: Signal(good["time"], good[n]) for n in ("quat", "rate", "vel")}
    _, (finding,) = check_units(Recording("log", signals), True)
    assert finding.level == "ok" and "position" not in finding.text


def recording(late_s, noise=1e-3, seed=0):
    rng = np.random.default_rng(seed)
    truth = known_flight.fly(np.arange(0, 12, 0.01))
    quat = truth.quat + noise * rng.normal(size=truth.quat.shape)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return Recording(
        "log",
        {
            "quat": Signal(truth.time + late_s, quat),
            "pos": Signal(truth.time + late_s, truth.pos),
            "rate": Signal(truth.time, truth.rate + 0.02 * rng.normal(size=truth.rate.shape)),
        },
    )


@pytest.mark.parametrize("late_s", [0.02, -0.013])
def test_a_late_pose_is_moved_with_its_position(late_s):
    late = recording(late_s)
    moved, findings = check_delay(late, True)
    assert findings[0].level == "corrected"
    for name in ("quat", "pos"):
        error = moved.signals[name].time_s[0] - 0.0
        assert abs(error) < 1e-3
    np.testing.assert_array_equal(moved.signals["rate"].time_s, late.signals["rate"].time_s)
    kept, findings = check_delay(late, False)
    assert findings[0].level == "doubt"
    assert kept is late


def test_a_pose_on_time_is_left_alone():
    here = recording(0.0)
    kept, findings = check_delay(here, True)
    assert kept is here
    assert findings[0].level == "ok"


def test_the_standard_error_is_that_of_the_delay():
    off = []
    for seed in range(12):
        found = delay_of(*(recording(0.01, 0.004, seed).signals[n] for n in ("quat", "rate")))
        assert found is not None
        off.append((found[0] - 0.01) / found[1])
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 2.0


@pytest.mark.parametrize("reading", READINGS[1:])
def test_a_late_pose_is_moved_however_its_attitude_is_written(reading):
    order, inverse, turned = reading
    late = recording(0.03)
    quat, rate = late.signals["quat"], late.signals["rate"]
    value = as_read(quat.value, "wxyz", inverse)
    value = value[:, [1, 2, 3, 0]] if order == "xyzw" else value
    gyro = rate.value * HALF_TURN if turned else rate.value
    written = {"quat": quat._replace(value=value), "rate": rate._replace(value=gyro)}
    moved, findings = check_delay(replace(late, signals={**late.signals, **written}), True)
    assert findings[0].level == "corrected"
    assert abs(moved.signals["pos"].time_s[0]) < 1e-3
