"""The diagnosis on flights made by MuJoCo: nulls stay null, effects are named, wrong ones lose."""

import json
from dataclasses import replace

import numpy as np
import pytest

from eval.logs.flight_log import write_flight
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from suite.cli import main
from suite.diagnose.diagnose import diagnose
from suite.diagnose.report.diagnosis_json import diagnosis_json
from tests.support.diagnosis_flights import fly
from tests.support.vehicles import PLAIN, with_effects, with_lag

LAGGED = with_lag(PLAIN, 0.03)
CASES = {
    "linear_drag": ("coefficient", (0.1, 0.1, 0.05)),
    "com_offset": ("offset", (0.001, -0.0005, 0.0)),
    "gyro_bias": ("bias", (0.02, 0.0, -0.01)),
    "weak_motor": ("scale", (1.0, 0.96, 1.0, 1.0)),
}

SLOW = ("com_offset", "weak_motor")


def flights(vehicle, seed=0, count=3, **options):
    return [fly(vehicle, seed + k, duration_s=7.0, **options) for k in range(count)]


def within(entry, truth):
    value = np.atleast_1d(np.array(entry["ci95"], dtype=float))
    low, high = value.reshape(-1, 2).T
    middle, half = (low + high) / 2, (high - low) / 2
    return np.all(np.abs(np.atleast_1d(truth) - middle) < 2 * half + 1e-12)


def test_flights_of_the_vehicle_itself_have_no_gap():
    found = diagnosis_json(diagnose(flights(LAGGED), LAGGED))
    assert (found["verdict"], found["effects"]) == ("no_gap", [])
    assert 0.8 < found["gap"]["before"] < 1.2


@pytest.mark.parametrize(
    "name",
    ["linear_drag", "gyro_bias", *(pytest.param(n, marks=pytest.mark.slow) for n in SLOW)],
)
def test_an_effect_is_named_with_its_value(name):
    parameter, truth = CASES[name]
    found = diagnosis_json(diagnose(flights(with_effects(LAGGED, **{name: (truth,)})), LAGGED))
    assert found["verdict"] == "named"
    (effect,) = found["effects"]
    assert name in (effect["name"], *effect["alternatives"])
    assert found["gap"]["after"] < 1.15
    if effect["name"] == name:
        seen = truth[1] if name == "weak_motor" else truth
        entry = effect["parameters"][parameter]
        if name == "com_offset":
            assert entry["value"][2] is None
            seen, entry = truth[:2], {"ci95": entry["ci95"][:2]}
        assert within(entry, seen)
    if found["control"] is not None:
        assert found["control"]["after"] > found["gap"]["after"]


def test_a_force_outside_the_catalogue_is_not_called_by_a_name_alone():
    def swing(motion, t):
        return np.array([0.8 * np.sin(2 * np.pi * 1.3 * t), 0.8 * np.cos(2 * np.pi * 1.1 * t), 0.0])

    found = diagnosis_json(diagnose(flights(LAGGED, extra=swing), LAGGED))
    assert found["verdict"] in ("unknown", "partly")


def test_files_come_out_whole_and_bad_flights_are_named(tmp_path, capsys):
    logs = flights(with_effects(LAGGED, thrust_scale=(0.95,)))
    paths = [str(write_flight(tmp_path / f"{k}.parquet", log)) for k, log in enumerate(logs)]
    (tmp_path / "bad.csv").write_text("time,pos_x\n0,1\n", encoding="utf-8")
    save_vehicle(LAGGED, tmp_path / "v.toml")
    out = tmp_path / "out"
    line = [*paths, str(tmp_path / "bad.csv"), "--vehicle", str(tmp_path / "v.toml")]
    assert main(["diagnose", *line, "--out", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    assert any("bad.csv" in warning for warning in printed["warnings"])
    names = {effect["name"] for effect in printed["effects"]}
    assert names and set(load_vehicle(out / "vehicle.toml").effects) == names
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "data:image/png" in page and "<script" not in page and 'src="http' not in page


def test_unusable_input_ends_with_2(tmp_path, capsys):
    assert main(["diagnose", str(tmp_path / "none.csv"), "--vehicle", "reference"]) == 2
    log = fly(LAGGED, 0, duration_s=1.2)
    path = write_flight(tmp_path / "short.parquet", log)
    assert main(["diagnose", str(path), "--vehicle", "reference"]) == 2
    assert "1.3 s" in capsys.readouterr().err


def test_what_drives_the_model_must_be_in_every_log():
    with pytest.raises(ValueError, match="motors"):
        diagnose([fly(LAGGED, 0, duration_s=2.0)], LAGGED, drive="motors")
    log = replace(fly(LAGGED, 0, duration_s=2.0), thrust_cmd=None, rate_cmd_b=None)
    with pytest.raises(ValueError, match="sort"):
        diagnose([log, fly(LAGGED, 1, duration_s=2.0)], LAGGED)
