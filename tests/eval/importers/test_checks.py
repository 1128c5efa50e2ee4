"""What goes wrong most in logs is found, said, and put right only where that is allowed."""

import csv

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eval.importers import import_log
from eval.importers.options import ImportOptions
from eval.importers.rows import averaged, smoothed
from eval.logs.columns import FlightLogError
from tests.support import known_flight
from tests.support.known_flight import FLIP

NAMES = {
    "pos": ["pos_x", "pos_y", "pos_z"],
    "quat": ["quat_w", "quat_x", "quat_y", "quat_z"],
    "vel": ["vel_x", "vel_y", "vel_z"],
    "rate": ["rate_x", "rate_y", "rate_z"],
    "acc": ["acc_x", "acc_y", "acc_z"],
    "cmd_thrust": ["cmd_thrust"],
    "cmd_rate": ["cmd_rate_x", "cmd_rate_y", "cmd_rate_z"],
}


def flight(hz=200.0, end=8.0, noise=0.0, seed=0):
    """The columns of a good table as arrays by signal."""
    truth = known_flight.fly(np.arange(0, end, 1 / hz))
    rng = np.random.default_rng(seed)
    parts = {
        "time": truth.time,
        "pos": truth.pos,
        "quat": truth.quat,
        "vel": truth.vel,
        "rate": truth.rate,
        "acc": truth.acc,
        "cmd_thrust": truth.thrust[:, None],
        "cmd_rate": truth.cmd_rate,
    }
    if noise:
        sizes = {"pos": 0.003, "vel": 0.05, "rate": 0.05, "acc": 0.5, "quat": 0.0015}
        for name, size in sizes.items():
            parts[name] = parts[name] + noise * size * rng.normal(size=parts[name].shape)
        parts["quat"] /= np.linalg.norm(parts["quat"], axis=1, keepdims=True)
    return parts


def write(path, parts, keep=None):
    """Write `parts` as CSV; cells that `keep` (signal -> mask of rows) leaves out stay empty."""
    columns = {"time": [repr(float(t)) for t in parts["time"]]}
    for name, names in NAMES.items():
        if name not in parts:
            continue
        mask = np.ones(len(parts["time"]), bool) if keep is None else keep.get(name)
        mask = np.ones(len(parts["time"]), bool) if mask is None else mask
        for k, column in enumerate(names):
            values = parts[name][:, k]
            columns[column] = [
                repr(float(v)) if m else "" for v, m in zip(values, mask, strict=True)
            ]
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(columns)
        table.writerows(zip(*columns.values(), strict=True))
    return path


def of(findings, level):
    return {finding.subject for finding in findings if finding.level == level}


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
    "NED positions": (
        lambda p: p | {name: p[name] @ FLIP for name in ("pos", "vel")},
        {"frames"},
    ),
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


def test_differing_rates_jitter_and_holes(tmp_path):
    rng = np.random.default_rng(1)
    time = np.cumsum(rng.uniform(0.003, 0.007, 1600))
    truth = known_flight.fly(time)
    parts = {"time": time, "pos": truth.pos, "quat": truth.quat, "rate": truth.rate}
    parts |= {"cmd_thrust": truth.thrust[:, None], "cmd_rate": truth.cmd_rate}
    every = np.arange(len(time))
    hole = (time > 3.0) & (time < 3.6)
    keep = {
        "pos": (every % 4 == 0) & ~hole,
        "quat": every % 2 == 0,
        "cmd_rate": every % 5 == 0,
        "cmd_thrust": every % 5 == 0,
    }
    log, findings = import_log(write(tmp_path / "log.csv", parts, keep))
    assert {"position", "rows"} <= of(findings, "note")
    at = log.time_s + time[0]
    np.testing.assert_allclose(at, time[keep["pos"]], atol=1e-9)
    found = known_flight.fly(at)
    np.testing.assert_allclose(log.pos_w, found.pos, atol=1e-9)
    np.testing.assert_allclose(log.rate_b, found.rate, atol=2e-3)
    # A derived velocity is not there beside the hole.
    assert log.velocity_derived
    clear = (at < 2.9) | (at > 3.8)
    np.testing.assert_allclose(log.vel_w[clear], found.vel[clear], atol=0.1)


@pytest.mark.parametrize(("pos", "quat", "vel"), [(4, 1, 8), (10, 5, 10), (2, 3, 2)])
def test_a_measurement_is_in_one_row_only(tmp_path, pos, quat, vel):
    """Values copied to rows between them would look like less noise than there is."""
    good = flight(noise=1.0)
    every = np.arange(len(good["time"]))
    keep = {"pos": every % pos == 0, "quat": every % quat == 1 % quat, "vel": every % vel == 0}
    log, _ = import_log(write(tmp_path / "log.csv", good, keep))
    for name, value in (("pos", log.pos_w), ("quat", log.quat_wxyz), ("vel", log.vel_w)):
        count = np.isfinite(value[:, 0]).sum()
        assert count <= keep[name].sum() and count > 0.9 * min(keep[name].sum(), len(value))
    both = (every % np.lcm(pos, vel) == 0).sum()
    assert log.whole.sum() > 0.9 * min(both, len(log.time_s))
    # Slower than 20 Hz only with rows between.
    assert 1 / np.median(np.diff(log.time_s)) > 19.0


def test_faster_signals_are_smoothed_and_commands_hold_their_mean(tmp_path):
    parts = flight(hz=1000.0, end=6.0)
    shake = 5.0 * np.sin(2 * np.pi * 240.0 * parts["time"])[:, None]
    parts["rate"] = parts["rate"] + shake
    path = write(tmp_path / "log.csv", parts)
    log, _ = import_log(path, None, ImportOptions(rate_hz=50.0))
    truth = known_flight.fly(log.time_s)
    assert len(log.time_s) == 300
    assert np.abs(log.rate_b - truth.rate)[2:-2].max() < 1.0
    middle = known_flight.fly(log.time_s + 0.0095).cmd_rate
    np.testing.assert_allclose(np.asarray(log.rate_cmd_b)[:-1], middle[:-1], atol=0.01)


def test_smoothing_does_not_flatten_what_is_curved():
    t = np.arange(0.0, 2.0, 0.001)
    wave = np.sin(2 * np.pi * 8.0 * t)[:, None]
    at = np.arange(0.1, 1.9, 0.01)
    exact = np.sin(2 * np.pi * 8.0 * at)[:, None]
    assert np.abs(smoothed(t, wave, at, 0.01) - exact).max() < 5e-4
    assert np.abs(averaged(t, wave, at, 0.01) - exact).max() > 5e-3
    noise = np.random.default_rng(0).normal(size=wave.shape)
    assert np.std(smoothed(t, noise, at, 0.01)) < 0.55


def test_a_command_that_stops_is_not_held_for_long(tmp_path):
    good = flight()
    before = good["time"] < 5.0
    path = write(tmp_path / "log.csv", good, {"cmd_rate": before, "cmd_thrust": before})
    log, _ = import_log(path)
    missing = np.isnan(np.asarray(log.thrust_cmd))
    assert missing[log.time_s > 5.6].all() and not missing[log.time_s < 5.4].any()


def test_two_flights_in_one_file_are_refused(tmp_path):
    good = flight(end=3.0)
    twice = {name: np.concatenate([value, value]) for name, value in good.items()}
    with pytest.raises(FlightLogError, match="cut the file to one flight"):
        import_log(write(tmp_path / "log.csv", twice))


def test_half_a_command_is_left_out_or_refused(tmp_path):
    good = flight()
    lone = {name: value for name, value in good.items() if name != "cmd_thrust"}
    path = write(tmp_path / "log.csv", lone)
    with pytest.raises(FlightLogError, match="neither a thrust and rate command nor motor"):
        import_log(path)
