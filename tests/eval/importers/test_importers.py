"""An import as a whole: formats are detected, what is read can be written, cut and refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.formats import FORMATS, detect
from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError
from eval.logs.flight_log import read_flight, write_flight
from tests.support import foreign_logs as made
from tests.support import known_flight
from tests.support.imported import flight, levels, near, write

FULL = ImportOptions(full_thrust=30.0)


def test_an_import_can_be_written_and_read_back(tmp_path):
    log, _ = import_log(made.write_usd(tmp_path / "log00"), None, FULL)
    again = read_flight(write_flight(tmp_path / "flight.parquet", log))
    np.testing.assert_array_equal(again.pos_w, log.pos_w)
    assert again.about["imported_from"] == "log00" and again.about["findings"]


def test_a_log_of_ours_keeps_what_it_says_of_itself(tmp_path):
    log, _ = import_log(made.write_usd(tmp_path / "log00"), None, FULL)
    told = {"integrator": "euler", "step_s": 0.002, "seed": 7, "partial": ["motor"]}
    path = write_flight(tmp_path / "ours.parquet", replace(log, about={**log.about, **told}))
    again, _ = import_log(path)
    assert (again.integrator, again.step_s, again.about["seed"]) == ("euler", 0.002, 7)
    assert again.partial == () and again.about["source"] == log.about["source"]


def test_start_and_end_cut_the_flight(tmp_path):
    path = made.write_usd(tmp_path / "log00")
    log, _ = import_log(path, None, ImportOptions(full_thrust=30.0, start_s=2.0, end_s=5.0))
    assert log.duration_s == pytest.approx(3.0, abs=0.02)
    near(log.pos_w, known_flight.fly(log.time_s + 2.0).pos, 1e-5)
    with pytest.raises(FlightLogError, match="no row between --start and --end; .* first sample"):
        import_log(path, None, ImportOptions(start_s=50.0))


def test_a_source_is_asked_of_what_knows_of_sources(tmp_path):
    asked = replace(FULL, source="mocap")
    ours = write_flight(tmp_path / "ours.csv", import_log(made.write_usd(tmp_path / "log00"))[0])
    with pytest.raises(ValueError, match="--source mocap: the mapping of .* names no source"):
        import_log(ours, None, asked)
    with pytest.raises(ValueError, match="'px4', which has one source of the pose: leave --source"):
        import_log(made.write_ulog(tmp_path / "log.ulg"), None, asked)


LOGS = Path(__file__).resolve().parents[4] / "shared" / "real_logs"

real = pytest.mark.skipif(not LOGS.is_dir(), reason="the logs are not on this machine")


def read(path, name, **options):
    return import_log(LOGS / path, None, ImportOptions(map=Path(name), **options))


@real
def test_nanobench_has_motor_commands_battery_and_only_the_flight():
    log, findings = read("nanobench/B3_figure8_fast_rep1.csv", "nanobench")
    assert log.pwm is not None
    assert log.voltage is not None
    assert log.acc_b is not None
    assert 19.0 < log.duration_s < 21.0  # of 26.8 s
    assert np.nanmin(log.pwm) > 0.3
    assert abs(np.nanmean(log.acc_b[:, 2]) - 9.9) < 0.3
    assert log.about["beside"]["crazyflie_id"] == "CF_01"
    assert levels(findings)["gyro"] == "ok"


@real
def test_nanobench_motors_turn_the_body_as_the_shipped_order_says():
    """M1 and M3 turn counter-clockwise: more of them yaws the body clockwise."""
    log, _ = read("nanobench/B8_star_fast_rep2.csv", "nanobench")
    change = np.gradient(log.rate_b, log.time_s, axis=0)
    assert log.pwm is not None
    one, two, three, four = log.pwm.T
    drives = (three + four - one - two, two + three - one - four, two + four - one - three)
    for axis, drive in enumerate(drives):
        both = np.isfinite(drive[:-3]) & np.isfinite(change[3:, axis])
        assert np.corrcoef(drive[:-3][both], change[3:, axis][both])[0, 1] > 0.15


@real
def test_nanobench_by_the_estimate_is_late_and_moved():
    log, findings = read("nanobench/B8_star_fast_rep2.csv", "nanobench", source="estimate")
    assert levels(findings)["pose delay"] == "corrected"
    assert log.duration_s > 30


@pytest.mark.parametrize("source", ["", "estimate"])
def test_an_estimate_next_to_motion_capture_is_kept(tmp_path, source):
    columns = {"t": np.arange(0.0, 4.0, 0.01)}
    half = 0.1 * np.sin(columns["t"])
    quat = np.stack([np.cos(half), np.sin(half), 0.0 * half, 0.0 * half])
    parts = {"x": columns["t"] ** 2, "y": 0.0 * half, "z": 1.0 + half}
    for k, (name, value) in enumerate(parts.items()):
        columns |= {name: value, f"e{name}": 1e3 * (value + 0.01 * (k + 1))}
    columns |= {f"{p}q{a}": v for p in ("", "e") for a, v in zip("wxyz", quat, strict=True)}
    columns |= {"gx": np.gradient(2.0 * half, 0.01), "gy": 0.0 * half, "gz": 0.0 * half}
    np.savetxt(
        tmp_path / "log.csv", np.stack([*columns.values()], 1), "%.9g", ",",
        header=",".join(columns), comments="",
    )  # fmt: skip
    text = '[time]\ncolumn = "t"\n[rate]\ncolumns = ["gx", "gy", "gz"]\n'
    for start, where, unit in (("", "mocap", "m"), ("e", "estimate", "mm")):
        names = [f"{start}{axis}" for axis in "xyz"]
        text += f'[[pos]]\ncolumns = {names}\nunit = "{unit}"\nsource = "{where}"\n'
        names = [f"{start}q{part}" for part in "wxyz"]
        text += f'[[quat]]\ncolumns = {names}\nsource = "{where}"\n'
    (tmp_path / "map.toml").write_text(text)
    options = ImportOptions(
        map=tmp_path / "map.toml", source=source, partial=True, trim=False, fix=False
    )
    log, _ = import_log(tmp_path / "log.csv", None, options)
    kept = {name for name in log.extra if name.startswith("est_")}
    if source:
        assert not kept
        return
    assert kept == {f"est_pos_{a}" for a in "xyz"} | {f"est_quat_{a}" for a in "wxyz"}
    for k, axis in enumerate("xyz"):
        near(log.extra[f"est_pos_{axis}"] - log.pos_w[:, k], 0.01 * (k + 1), 1e-6)


@real
@pytest.mark.parametrize(
    ("path", "lacks"),
    [
        ("motor/add_weight_W3_near_M3__E9_log00", ("quat", "rate")),
        ("controller/add_weight_W3_near_M3__E9_log01", ("quat",)),
    ],
)
def test_crazypad_is_partial_and_shows_the_weight_near_rotor_3(path, lacks):
    log, findings = read(f"crazypad/{path}", "crazypad", partial=True)
    assert log.partial == lacks
    assert levels(findings)["partial"] == "note"
    assert log.pwm is not None
    mean = np.nanmean(log.pwm, axis=0)
    assert np.argmax(mean) == 2
    assert 20.0 < log.duration_s < 24.0


@real
def test_crazyswarm2_has_thrust_by_the_mass_beside_it_and_torque():
    log, _ = read("crazyswarm2/log10", "crazyswarm2")
    assert log.torque_cmd_b is not None and log.thrust_cmd is not None
    assert log.about["mass"] == 0.0333
    np.testing.assert_allclose(log.thrust_cmd, log.extra["cmd_force"] / 0.0333)
    assert 6.0 < np.nanmean(log.thrust_cmd) < 10.0
    assert log.rate_cmd_b is None


def test_unknown_formats_and_files(tmp_path):
    with pytest.raises(ValueError, match="Did you mean 'px4'"):
        import_log(tmp_path / "x", "px")
    with pytest.raises(FlightLogError, match="cannot be read"):
        import_log(tmp_path / "none.ulg")
    noise = tmp_path / "noise.bin"
    noise.write_bytes(bytes(range(256)) * 40)
    for name in (None, *FORMATS):
        with pytest.raises(FlightLogError, match=r"noise\.bin"):
            import_log(noise, name)


def test_each_format_is_told_by_its_first_bytes(tmp_path):
    table = write(tmp_path / "table.csv", flight(end=1.5))
    (tmp_path / "log.bin").write_bytes(b"\xa3\x95\x80\x80\x59FMT")
    files = {
        "ardupilot": tmp_path / "log.bin",
        "px4": made.write_ulog(tmp_path / "log.ulg", span=(0, 2)),
        "betaflight": made.write_blackbox(tmp_path / "log.csv", span=(0, 2)),
        "crazyflie": made.write_usd(tmp_path / "log00", span=(0, 2)),
        "mcap": made.write_mcap(tmp_path / "log.mcap", span=(0, 2)),
        "table": table,
    }
    for name, path in files.items():  # by what is in it, whatever it is called
        assert detect(path.rename(tmp_path / "renamed"), ImportOptions()) == name
    assert files.keys() == set(FORMATS)
