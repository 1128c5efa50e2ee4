"""From flight logs to a checkpoint with its report, and the dynamics that it may correct."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eval.logs.flight_log import write_flight
from eval.quadrotor.vehicle_file import load_vehicle
from policies.formats.policy_file import load_delta
from suite.common.console import Console
from suite.delta.fit import FitConfig
from suite.delta.replay import check_corrects, describe_dynamics, nominal_model
from suite.delta.run import fit_delta, flight_files, long_enough, split, table
from suite.train.config import PointMassConfig, QuadrotorConfig
from suite.train.recipes import race, race_paper
from tests.support.point_mass_flights import fly
from tests.support.vehicles import with_lag
from tracks.common.files import plain

PHYSICS = PointMassConfig(drag=(0.3, 0.3), drag_up=(0.3, 0.3), action_delay=(0.5, 0.5))


def test_logs_become_a_checkpoint_with_its_report(tmp_path):
    (tmp_path / "logs").mkdir()
    for i, log in enumerate(fly(nominal_model(PHYSICS), 3)):
        thrust = np.full_like(log.time_s, 9.81)
        commanded = replace(log, thrust_cmd=thrust, rate_cmd_b=log.rate_b)
        write_flight(tmp_path / "logs" / f"{i}.parquet", commanded)
    config = FitConfig(horizon_s=0.6, iterations=3, batch=8, held_out=0.4)
    result = fit_delta(config, PHYSICS, [tmp_path / "logs"], tmp_path / "out", Console())
    stored = load_delta(tmp_path / "out" / "delta").params
    for name, value in result.params.items():
        np.testing.assert_array_equal(stored[name], value)
    assert (tmp_path / "out" / "table.md").read_text() == table(result, 0.6)
    with pytest.raises(ValueError, match="no flight logs in"):
        fit_delta(config, PHYSICS, [tmp_path / "out"], tmp_path / "again", Console())
    assert not (tmp_path / "again").exists()
    twice = [tmp_path / "logs", tmp_path / "logs" / "a" / ".." / "0.parquet"]
    (tmp_path / "logs" / "a").mkdir()
    assert len(flight_files(twice)) == 3, "a flight that is named twice counts once"


@pytest.mark.parametrize("dynamics", [PHYSICS, QuadrotorConfig(load_vehicle("reference"))])
@pytest.mark.parametrize("missing", ["action_y", "policy_step", "decisions", "cmd_thrust"])
def test_flights_without_what_a_fit_needs_are_refused(tmp_path, dynamics, missing):
    if missing == "cmd_thrust" and dynamics is PHYSICS:
        pytest.skip("the point mass needs no commands")
    for i, log in enumerate(fly(nominal_model(PHYSICS), 2, seconds=1.5)):
        extra = {name: column for name, column in log.extra.items() if name != missing}
        if missing == "decisions":
            extra["policy_step"] = np.zeros(len(log.time_s))
        speeds = {"rotor_speed": np.full((len(log.time_s), 4), 900.0)}
        commands = {"thrust_cmd": np.full_like(log.time_s, 9.81), "rate_cmd_b": log.rate_b}
        given = speeds if missing == "cmd_thrust" else commands
        write_flight(tmp_path / f"{i}.parquet", replace(log, extra=extra, **given))
    with pytest.raises(ValueError, match=r"record (longer )?flights with suite collect"):
        fit_delta(FitConfig(), dynamics, [tmp_path], tmp_path / "out", Console())


@pytest.mark.parametrize("share", [0.01, 0.25, 0.5, 0.99])
def test_a_split_has_no_overlap_and_leaves_nobody_out(share):
    logs = fly(nominal_model(PointMassConfig()), 7, seconds=1.5)
    for seed in range(5):
        known, held = split(logs, share, seed)
        names = [log.name for log in (*known, *held)]
        assert sorted(names) == sorted(log.name for log in logs) and len(set(names)) == 7
        assert known and len(held) == min(6, max(1, round(share * 7)))
    assert [log.name for log in split(logs, 0.5, 0)[1]] != [
        log.name for log in split(logs, 0.5, 1)[1]
    ]


def test_a_flight_shorter_than_a_window_is_not_what_is_held_out():
    logs = fly(nominal_model(PointMassConfig()), 3, seconds=1.5)
    crash = fly(nominal_model(PointMassConfig()), 1, seconds=0.8)[0]
    crash = replace(crash, name="crash")
    kept, words = long_enough([*logs, crash], 1.0)
    assert [log.name for log in kept] == [log.name for log in logs]
    assert words == ["crash: left out, it lasts 0.77 s and a window 1 s"]
    assert long_enough([logs[0], crash], 1.0) == ([logs[0], crash], [])


def test_what_cannot_be_split_is_refused():
    log = fly(nominal_model(PointMassConfig()), 1, seconds=1.5)
    with pytest.raises(ValueError, match="1 flight given, at least 2"):
        split(log, 0.25, 0)
    for share in (0.0, 1.0, float("nan")):
        with pytest.raises(ValueError, match=f"held_out is {share}"):
            split(log * 2, share, 0)


WHERE = Path("runs/delta/delta")


def kept(dynamics):
    """Return what stands in the checkpoint, as JSON gives it back."""
    import json

    return json.loads(json.dumps(plain({"iterations": 3, **describe_dynamics(dynamics)})))


def test_the_middle_of_the_ranges_is_what_counts():
    physics = race().physics
    check_corrects(kept(physics), physics, 15.0, WHERE)
    check_corrects(kept(physics), replace(physics, drag=(0.0, 0.9), lag_std=0.0), 15.0, WHERE)
    check_corrects({}, physics, 15.0, WHERE)
    words = "drag 0.45 0.45 1.1 1/s.* this run's has .*drag 0.45 0.45 0.45 1/s.*--recipe"
    with pytest.raises(ValueError, match=words):
        check_corrects(kept(physics), race_paper().physics, 15.0, WHERE)
    with pytest.raises(ValueError, match="delay 1 decisions; take"):
        check_corrects(kept(physics), replace(physics, action_delay=(0.5, 1.5)), 15.0, WHERE)


def test_of_a_vehicle_all_but_its_name_counts():
    vehicle = load_vehicle("reference")
    stored = kept(QuadrotorConfig(vehicle))
    check_corrects(
        stored, QuadrotorConfig(replace(vehicle, name="mine"), mass_std=0.0), 15.0, WHERE
    )
    other = replace(with_lag(vehicle, 0.05), name="other")
    with pytest.raises(ValueError, match="another vehicle than 'other'; take its --vehicle"):
        check_corrects(stored, QuadrotorConfig(other), 15.0, WHERE)
    with pytest.raises(ValueError, match="corrects --model quad, and this run has --model point"):
        check_corrects(stored, PointMassConfig(), 15.0, WHERE)
    with pytest.raises(ValueError, match="corrects --model point, and this run has --model quad"):
        check_corrects({}, QuadrotorConfig(vehicle), 15.0, WHERE)


def test_a_network_that_steps_at_another_rate_is_refused():
    physics = race().physics
    fit = {**kept(physics), "rate_hz": 15.03}
    check_corrects(fit, physics, 15.0, WHERE)
    with pytest.raises(ValueError, match="with 15 decisions a second, and this run has 30: .*=15"):
        check_corrects(fit, physics, 30.0, WHERE)
