"""Which logs go by views, and what is written of them."""

import json
from dataclasses import replace

import numpy as np

from eval.logs.flight_log import write_flight
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from suite.cli import main
from suite.diagnose.sources.rollouts import can_fly
from tests.support.diagnosis_flights import fly
from tests.support.real_flights import VEHICLE, flights
from tests.support.vehicles import PLAIN, REMEMBERING


def test_logs_without_what_a_rollout_needs_go_by_views():
    (log,) = flights(1, duration_s=2.0)
    assert can_fly([log], VEHICLE)
    assert not can_fly([replace(log, about={"partial": ["quat"]})], VEHICLE)
    driven = replace(log, rotor_speed=None, thrust_cmd=None, rate_cmd_b=None)
    assert not can_fly([replace(driven, pwm=np.full((len(log.time_s), 4), 0.5))], VEHICLE)


def test_a_loop_that_remembers_goes_by_views_where_no_rotor_speeds_were_measured():
    commands = fly(PLAIN, 0, duration_s=2.0)
    assert can_fly([commands], PLAIN) and not can_fly([commands], REMEMBERING)
    assert can_fly([fly(PLAIN, 0, duration_s=2.0, motors=True)], REMEMBERING)


def test_a_change_is_written_as_every_diagnosis_is(tmp_path, capsys):
    save_vehicle(VEHICLE, tmp_path / "v.toml", "for a test")
    for folder, seed, effects in (("new", 8, {"mass_offset": (0.15,)}), ("old", 9, {})):
        (tmp_path / folder).mkdir()
        for number, log in enumerate(flights(3, seed=seed, speed=1.0, hidden=effects)):
            write_flight(tmp_path / folder / f"{number}.parquet", log)
    words = ["diagnose", str(tmp_path / "new"), "--reference", str(tmp_path / "old"), "--plan",
             "--drive", "motors", "--vehicle", str(tmp_path / "v.toml"),
             "--out", str(tmp_path / "out")]  # fmt: skip
    assert main([*words, "--json"]) == 0
    said = capsys.readouterr()
    told = json.loads(said.out)
    names = {name for e in told["effects"] for name in (e["name"], *e["alternatives"])}
    assert "mass_offset" in names and told["views"] and len(told["reference"]) == 3
    for flag in ("--plan", "--drive"):
        assert any(flag in line for line in told["warnings"])
        assert f"warning: {flag} needs rollouts" in said.err
    for axis in told["gap"]["channels"]["force"].values():
        assert {"before", "after", "noise_floor", "repeatability"} <= set(axis)
    assert json.loads((tmp_path / "out/diagnosis.json").read_text())["verdict"] == told["verdict"]
    assert "data:image/png" in (tmp_path / "out/report.html").read_text()
    assert load_vehicle(str(tmp_path / "out/vehicle.toml")).effects


def test_a_lone_reference_is_an_error_of_one_line(tmp_path, capsys):
    save_vehicle(VEHICLE, tmp_path / "v.toml", "for a test")
    for number, log in enumerate(flights(2, duration_s=3.0)):
        write_flight(tmp_path / ("one.parquet" if number else "a.parquet"), log)
    words = ["diagnose", str(tmp_path / "a.parquet"), "--reference", str(tmp_path / "one.parquet"),
             "--vehicle", str(tmp_path / "v.toml"), "--out", str(tmp_path / "out")]  # fmt: skip
    assert main(words) == 2
    assert "at least 2" in capsys.readouterr().err
    assert not (tmp_path / "out" / "diagnosis.json").exists()
