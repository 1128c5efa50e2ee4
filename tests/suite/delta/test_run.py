"""From flight logs to a checkpoint with its report, and the dynamics that it may correct."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eval.logs.faults.finding import Finding
from eval.logs.flight_log import write_flight
from eval.quadrotor.vehicle_file import load_vehicle
from suite.common.console import Console
from suite.delta.fit import FitConfig
from suite.delta.replay import check_corrects, describe_dynamics, nominal_model
from suite.delta.run import fit_delta, flight_files, long_enough, split
from suite.train.config import PointMassConfig, QuadrotorConfig
from suite.train.recipes import race, race_paper
from tests.support.point_mass_flights import fly
from tests.support.vehicles import with_lag
from tracks.common.files import plain

PHYSICS = PointMassConfig(drag=(0.3, 0.3), drag_up=(0.3, 0.3), action_delay=(0.5, 0.5))


def test_flight_logs_are_found_once_and_without_any_nothing_is_written(tmp_path):
    with pytest.raises(ValueError, match="no flight logs in"):
        fit_delta(FitConfig(), PHYSICS, [tmp_path], tmp_path / "out", Console())
    assert not (tmp_path / "out").exists()
    (tmp_path / "a").mkdir()
    for name in ("0.parquet", "1.parquet", "2.csv"):
        (tmp_path / name).touch()
    twice = [tmp_path, tmp_path / "a" / ".." / "0.parquet"]
    assert len(flight_files(twice)) == 3, "a flight that is named twice counts once"


QUAD = QuadrotorConfig(load_vehicle("reference"))


@pytest.mark.parametrize(
    ("dynamics", "missing"),
    [(PHYSICS, "action_y"), (PHYSICS, "decisions"), (QUAD, "policy_step"), (QUAD, "cmd_thrust")],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_flights_without_what_a_fit_needs_are_refused(tmp_path, dynamics, missing, capsys):
    doubt = Finding("doubt", "motors", "6 motors turn", "motor_count", 6.0, 0.97, "none")
    kept = {"findings": [doubt._asdict()]}
    for i, log in enumerate(fly(nominal_model(PHYSICS), 2, seconds=1.5)):
        extra = {name: column for name, column in log.extra.items() if name != missing}
        if missing == "decisions":
            extra["policy_step"] = np.zeros(len(log.time_s))
        given = {"thrust_cmd": np.full_like(log.time_s, 9.81), "rate_cmd_b": log.rate_b}
        if missing == "cmd_thrust":
            given = {"rotor_speed": np.full((len(log.time_s), 4), 900.0)}
        about = {**kept, "vehicle": f"drone {i}"}
        write_flight(tmp_path / f"{i}.parquet", replace(log, extra=extra, about=about, **given))
    with pytest.raises(ValueError, match=r"record (longer )?flights with suite collect"):
        fit_delta(FitConfig(), dynamics, [tmp_path], tmp_path / "out", Console())
    # A log that an earlier step does not refuse repeats the open findings of its import.
    said = capsys.readouterr().err
    assert missing != "cmd_thrust" or ("6 motors turn" in said and "vehicle_mixed" in said)


@pytest.fixture(scope="module")
def logs():
    return fly(nominal_model(PHYSICS), 7, seconds=1.5)


@pytest.mark.parametrize("share", [0.01, 0.25, 0.5, 0.99])
def test_a_split_has_no_overlap_and_leaves_nobody_out(logs, share):
    splits = []
    for seed in range(5):
        known, held = ([log.name for log in part] for part in split(logs, share, seed))
        assert sorted(known + held) == sorted(log.name for log in logs)
        assert known and len(held) == min(6, max(1, round(share * 7)))
        splits.append(tuple(held))
    assert len(set(splits)) > 1, "another seed holds out others"


def test_what_cannot_be_split_is_refused_and_flights_shorter_than_a_window_are_left_out(logs):
    with pytest.raises(ValueError, match="1 flight given, at least 2"):
        split(logs[:1], 0.25, 0)
    for share in (0.0, 1.0, float("nan")):
        with pytest.raises(ValueError, match=f"held_out is {share}"):
            split(logs, share, 0)
    crash = replace(fly(nominal_model(PHYSICS), 1, seconds=0.8)[0], name="crash")
    kept, words = long_enough([*logs, crash], 1.0)
    assert [log.name for log in kept] == [log.name for log in logs]
    assert words == ["crash: left out, it lasts 0.77 s and a window 1 s"]
    assert long_enough([logs[0], crash], 1.0) == ([logs[0], crash], [])


def corrects(fitted, flown, rate_hz=15.0):
    """Check a run's dynamics against those that a checkpoint of 15 Hz has, as JSON has them."""
    fit = None if fitted is None else {"rate_hz": 15.03, **describe_dynamics(fitted)}
    kept = json.loads(json.dumps(plain(fit or {})))
    check_corrects(kept, flown, rate_hz, Path("runs/delta/delta"))


def test_the_middle_of_the_ranges_the_rate_and_all_of_a_vehicle_but_its_name_count():
    physics = race().physics
    corrects(None, physics)
    corrects(physics, replace(physics, drag=(0.0, 0.9), lag_std=0.0))
    words = "drag 0.45 0.45 1.1 1/s.* this run's has .*drag 0.45 0.45 0.45 1/s.*--recipe"
    with pytest.raises(ValueError, match=words):
        corrects(physics, race_paper().physics)
    with pytest.raises(ValueError, match="delay 1 decisions; take"):
        corrects(physics, replace(physics, action_delay=(0.5, 1.5)))
    with pytest.raises(
        ValueError, match="with 15 decisions a second, and this run has 30: .*--finetune .*=15"
    ):
        corrects(physics, physics, rate_hz=30.0)
    renamed = replace(QUAD, vehicle=replace(QUAD.vehicle, name="mine"), mass_std=0.0)
    corrects(QUAD, renamed)
    other = QuadrotorConfig(replace(with_lag(QUAD.vehicle, 0.05), name="other"))
    with pytest.raises(ValueError, match="another vehicle than 'other'; take its --vehicle"):
        corrects(QUAD, other)
    for fitted, flown, words in ((QUAD, PHYSICS, "quad, .* point"), (None, QUAD, "point, .* quad")):
        with pytest.raises(ValueError, match=f"corrects --model {words}"):
            corrects(fitted, flown)
