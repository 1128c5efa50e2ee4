"""suite collect: logs that read back, and flights that are none."""

import json
import re
import shutil

import numpy as np
import pytest

import eval.judging.judge
import eval.logs.flight_log
import suite.judging.collect
from eval.logs.flight_log import read_flight
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from eval.worlds import nearest
from suite.common.errors import FAILED
from tests.support.commands import answer, refused, run
from tests.support.engines import STAND_IN
from tests.support.judged_cells import cut_short
from tests.support.vehicles import with_effects

GATE = "[[gates]]\ncenter = [{x}, 0.0, 1.3]\nwidth = 1.0\nheight = 1.0\n"
COURSE = GATE.format(x=0.0) + GATE.format(x=5.0)
SENSORS = 'name = "mine"\n[[state]]\nkind = "state_noise"\nvelocity = 1.0\n'
TWO = "collect --track zigzag --difficulty 0 --trials 2 --seed 7 --time-limit-s 1.1"


def test_collect_writes_logs_that_read_back_and_goes_on(pilots, tmp_path, monkeypatch, capfd):
    out = tmp_path / "flights"
    args = (TWO, "--policy", pilots["pursuit"], "--out", out)
    assert run(*args) == 0
    logs = sorted(out.glob("*.parquet"))
    assert [log.name for log in logs] == ["zigzag-0-7.parquet", "zigzag-0-8.parquet"]
    log = read_flight(logs[0])
    assert log.about["seed"] == 7 and log.time_s[-1] >= 1
    assert (log.integrator, log.step_s) == ("euler", 0.002)
    found = json.loads((out / "flights.json").read_text())
    assert [row["file"] for row in found["flights"]] == [log.name for log in logs]
    logs[1].unlink()
    flown = cut_short(monkeypatch)
    assert answer(capfd, *args)["flights"] == found["flights"]
    assert [trial.seed for trial in flown] == [8]
    shutil.copy(logs[0], out / "other.parquet")
    assert "other.parquet" in refused(capfd, *args)


@pytest.mark.extended
def test_an_interrupted_collection_names_the_setting_that_differs(
    pilots, tmp_path, monkeypatch, capfd
):
    args = ("--policy", pilots["pursuit"], "--out", tmp_path / "flights")
    cut_short(monkeypatch, stop_after=1)
    assert run(TWO, *args) == 130
    for name, old, new in (
        ("seed", "7", "8"),
        ("trials", "2", "1"),
        ("time_limit_s", "1.1", "9.1"),
    ):
        option = f"--{name.replace('_', '-')} "
        said = refused(capfd, TWO.replace(option + old, option + new), *args)
        assert f"flown otherwise (collection.{name} is {old} there, {new} here)" in said
    assert run(TWO, *args) == 0


def test_flights_of_another_course_or_code_are_not_taken_for_its_own(
    pilots, tmp_path, monkeypatch, capfd
):
    track, sensors = tmp_path / "course.toml", tmp_path / "sensors.toml"
    sensors.write_text(SENSORS)
    args = ("collect --policy", pilots["diver"], "--track", track, "--out", tmp_path / "flights")
    args = (*args, "--sensors", sensors)
    for text in (COURSE, f"# in other words\n{COURSE}"):
        track.write_text(text)
        assert run(*args) == FAILED, "no log"
    with monkeypatch.context() as patch:
        patch.setattr(suite.judging.collect, "git_commit", lambda: "another")
        assert re.search("git_commit is '.*' there, 'another' here", refused(capfd, *args))
    with monkeypatch.context() as patch:
        patch.setattr(suite.judging.collect, "engines", lambda: {"numpy": "another"}, False)
        assert "engines.numpy is" in refused(capfd, *args)
    assert "collection.seed is 100000 there, 5 here" in refused(capfd, *args, "--seed", 5)
    for file, text, words in ((track, COURSE, "tracks."), (sensors, SENSORS, "sensors.")):
        file.write_text(text.replace("1.0", "1.1"))
        assert f"is of other flights ({words}" in refused(capfd, *args)
        file.write_text(text)


def test_flights_are_the_same_where_policy_and_vehicle_were_moved(
    pilots, tmp_path, monkeypatch, root, capfd
):
    vehicle, out = tmp_path / "mine.toml", tmp_path / "flights"
    shutil.copy(root / "eval" / "vehicles" / "racer5.toml", vehicle)
    line = "collect --track zigzag --difficulty 0 --trials 1 --policy"
    args = (line, pilots["diver"], "--out", out, "--vehicle")
    assert run(*args, vehicle) == FAILED
    moved = vehicle.rename(tmp_path / "moved.toml")
    monkeypatch.setattr(eval.judging.judge, "fly", None)
    (row,) = json.loads((out / "flights.json").read_text())["flights"]
    assert row["file"] is None and row["time_s"] < 1, "a flight of under a second is no log"
    assert not list(out.glob("*.parquet"))
    listed = out / "flights.json"
    assert f"no flight has a log; {listed} tells how each ended" in capfd.readouterr().err
    assert run(*args, moved) == FAILED, "nothing is flown again"
    assert "0 flights in mujoco" not in capfd.readouterr().err
    moved.write_text(moved.read_text().replace("mass = 0.75", "mass = 0.76"))
    assert run(*args, moved) == 2


@pytest.mark.extended
def test_a_simulator_that_differs_from_the_vehicle_file_writes_the_file_that_describes_its_flights(
    pilots, tmp_path, monkeypatch, capfd
):
    monkeypatch.setattr("eval.worlds.rotorpy.rotorpy", lambda: STAND_IN)
    for simulator in ("rotorpy", "mujoco"):
        out = tmp_path / simulator
        line = "collect --track zigzag --difficulty 0 --trials 1 --simulator", simulator
        assert run(*line, "--policy", pilots["diver"], "--out", out) == FAILED
        listed = json.loads((out / "flights.json").read_text())["as_flown"]
        path, said = out / "vehicle_as_flown.toml", capfd.readouterr().out
        assert path.exists() == (f"{path} describes these flights" in said) == bool(listed)
        assert listed == ("vehicle_as_flown.toml" if simulator == "rotorpy" else None)
    described = load_vehicle(tmp_path / "rotorpy" / "vehicle_as_flown.toml")
    flown = nearest("rotorpy", load_vehicle("reference"))
    assert described.effects.keys() == flown.effects.keys() >= {"hub_drag"}
    for name, values in described.effects.items():
        np.testing.assert_array_equal(np.hstack(values), np.hstack(flown.effects[name]), name)
    monkeypatch.setattr("suite.judging.collect.nearest", lambda *_: flown)
    assert run(TWO, "--policy", pilots["pursuit"], "--out", tmp_path / "named") == 0
    log = read_flight(tmp_path / "named" / "zigzag-0-7.parquet")
    assert log.about["vehicle"] == flown.name, "a diagnosis by this file has nothing to warn of"
    beyond = with_effects(flown, rotor_drag=(1.0,))
    monkeypatch.setattr("suite.judging.collect.nearest", lambda *_: beyond)
    assert run(*line, "--policy", pilots["diver"], "--out", tmp_path / "beyond") == FAILED
    assert "no vehicle file describes these flights: effects.rotor_drag" in capfd.readouterr().err


def test_a_log_has_the_log_faults_of_the_vehicle_and_what_acts_on_no_flight_is_said(
    pilots, tmp_path, capfd
):
    bias = (0.1, -0.05, 0.08)
    faults = {"gyro_bias": (bias,), "accelerometer_bias": (bias,), "battery_sag": (0.0, 0.1)}
    logs = {}
    for name, effects in (("plain", {}), ("faulty", faults)):
        vehicle = with_effects(load_vehicle("reference"), **effects)
        save_vehicle(vehicle, tmp_path / f"{name}.toml")
        args = ("--vehicle", tmp_path / f"{name}.toml", "--out", tmp_path / name)
        assert run(TWO, "--policy", pilots["pursuit"], *args) == 0
        logs[name] = read_flight(tmp_path / name / "zigzag-0-7.parquet")
        said = capfd.readouterr().err
        for note in ("battery_sag: acts only on logs with a voltage; for flights give rate",
                     "accelerometer_bias: acts only on logs with an accelerometer"):  # fmt: skip
            assert (note in said) == (name == "faulty")
    error = logs["faulty"].rate_b - logs["plain"].rate_b
    np.testing.assert_allclose(error, np.tile(bias, (len(error), 1)), atol=1e-12)
    np.testing.assert_array_equal(logs["faulty"].pos_w, logs["plain"].pos_w)


@pytest.mark.slow
def test_flights_with_a_log_fault_are_no_finding_for_their_own_vehicle_file(tmp_path, capfd):
    vehicle = with_effects(load_vehicle("reference"), gyro_bias=((0.1, -0.05, 0.08),))
    save_vehicle(vehicle, tmp_path / "biased.toml")
    own = ("--vehicle", tmp_path / "biased.toml", "--out")
    line = "collect --policy race-paper --track zigzag --difficulty 0 --trials 3"
    assert run(line, *own, tmp_path / "flights") == 0
    capfd.readouterr()
    found = answer(capfd, "diagnose", tmp_path / "flights", *own, tmp_path / "diagnosis")
    assert (found["verdict"], found["effects"]) == ("no_gap", [])


def test_a_flight_whose_log_is_refused_does_not_stop_the_others(
    pilots, tmp_path, monkeypatch, capfd
):
    log_from_flight = eval.logs.flight_log.log_from_flight

    def broken(flight, name):
        log = log_from_flight(flight, name)
        if name.endswith("-7.parquet"):
            log.rate_b[4, 0] = 300.0
        return log

    monkeypatch.setattr("suite.judging.collect.log_from_flight", broken)
    log = tmp_path / "zigzag-0-7.parquet"
    log.write_text("of an earlier collection, whose list was moved away")
    assert run(TWO, "--policy", pilots["pursuit"], "--out", tmp_path) == 0
    flights = json.loads((tmp_path / "flights.json").read_text())["flights"]
    assert [row["file"] for row in flights] == [None, "zigzag-0-8.parquet"]
    assert not log.exists(), "a diagnosis of the folder would use it"
    said = capfd.readouterr()
    assert "zigzag-0-7.parquet: column rate_x, row 5: 300" in said.err
    assert "1 without a log, 0 of them under 1 s; flights.json has how" in said.out


def test_what_cannot_be_recorded_is_refused(pilots, tmp_path, capfd):
    tracks = [tmp_path / name / "course.toml" for name in "ab"]
    for track in tracks:
        track.parent.mkdir()
        track.write_text(COURSE)
    asked = ("collect --policy", pilots["diver"], "--out", tmp_path / "out")
    said = refused(capfd, *asked, "--track", ",".join(map(str, tracks)))
    assert "several tracks are called 'course'" in said
    assert not (tmp_path / "out").exists()
