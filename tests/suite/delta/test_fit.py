"""From flight logs to a fitted model: what is learned of a known truth, refused and reported."""

import json
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from eval.logs.faults.catalogue import FAULTS
from eval.logs.faults.check import CheckContext
from eval.logs.faults.checked import CheckedFlights, read_checked
from eval.logs.faults.finding import Finding
from eval.logs.flight_log import flight_files, write_flight
from eval.quadrotor.vehicle_file import load_vehicle
from policies.formats.policy_file import load_delta
from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.delta.fit import (
    DeltaFit,
    FitConfig,
    ReplayErrors,
    _descend,
    _loss,
    fit_network,
    identify,
    window_errors,
)
from suite.delta.replay import (
    PointMassModel,
    check_corrects,
    describe_dynamics,
    nominal_model,
    replay_point_mass,
)
from suite.delta.run import errors_grid, fit_delta, long_enough, split
from suite.delta.windows import cut_windows, log_decisions, on_state_rows
from suite.train.config import PointMassConfig, QuadrotorConfig
from suite.train.overrides import with_changes
from suite.train.recipes import quick, race, race_paper
from tests.support.broken_logs import with_sent_commands
from tests.support.commands import run
from tests.support.point_mass_flights import fly
from tests.support.vehicles import with_lag
from tracks.common.files import plain
from tracks.common.grid import markdown
from tracks.common.provenance import stamp, stamp_text

PHYSICS = PointMassConfig(drag=(0.3, 0.3), drag_up=(0.3, 0.3), action_delay=(0.5, 0.5))
CONFIG = FitConfig(horizon_s=0.6, stride_s=0.3, iterations=100, batch=32, rate=1e-2, held_out=0.5)


@pytest.mark.extended
def test_lag_drag_and_delay_of_a_point_mass_are_identified_in_a_third_of_the_steps(monkeypatch):
    """Far from the middle: a rival that is fitted by half would flatter the network."""
    truth = PointMassModel(np.float32(6.0), np.array([0.1, 0.6, 0.25], np.float32), np.float32(1.6))
    windows = cut_windows(fly(truth, 6), 0.6, 0.15)
    config = FitConfig(horizon_s=0.6, iterations=600, batch=64)
    found = identify(config, PHYSICS, windows)
    assert float(found.lag) == pytest.approx(6.0, rel=0.05)
    assert float(found.delay) == pytest.approx(1.6, abs=0.1)
    np.testing.assert_allclose(found.drag, truth.drag, atol=0.04)
    taken: list[int] = []
    nothing: Any = None
    monkeypatch.setattr(
        "suite.delta.fit._descend", lambda *given: taken.append(given[4]) or given[2]
    )
    for iterations in (2, 9):
        identify(FitConfig(iterations=iterations), PHYSICS, nothing)
    assert taken == [1, 3]


def test_commands_in_rows_of_their_own_move_to_the_states_that_they_answer():
    """As in the logs of `suite fly`."""
    (log,) = fly(nominal_model(PHYSICS), 1)
    count = len(log.time_s)
    assert on_state_rows(log) is log
    log = replace(log, thrust_cmd=np.arange(count) + 1.0, rate_cmd_b=log.rate_b)
    assert on_state_rows(log) is log
    late_s = np.full(count, 0.2) * np.diff(log.time_s).min()
    sent = with_sent_commands(log, late_s)
    # At a state without an answer before the next one, the command before goes on.
    lost = np.arange(2 * count) != 9
    sent = replace(sent, thrust_cmd=np.where(lost, sent.thrust_cmd, np.nan))
    again = on_state_rows(sent)
    for name in ("time_s", "pos_w", "quat_wxyz", "vel_w", "rate_b"):
        np.testing.assert_array_equal(getattr(again, name), getattr(log, name))
    np.testing.assert_array_equal(again.policy_step, log.policy_step)
    held = np.where(np.arange(count) == 4, log.thrust_cmd[3], log.thrust_cmd)
    np.testing.assert_array_equal(again.thrust_cmd, held)
    np.testing.assert_array_equal(log_decisions(again)[1], log.policy_step)
    none = replace(sent, thrust_cmd=np.full(2 * count, np.nan))
    assert on_state_rows(none) is none


def push(vel_b, action_b):
    """A vehicle that gives nine tenths of what is asked and is pushed to its left."""
    return -0.1 * action_b + np.array([0.0, 0.8, -0.5], np.float32)


@pytest.mark.extended
def test_a_delta_action_cuts_the_error_of_a_perturbed_point_mass(tmp_path, monkeypatch):
    """As many flights are held out as are fitted: the errors of both are one program."""
    for number, log in enumerate(fly(nominal_model(PHYSICS), 8, extra_b=push)):
        commands = {"thrust_cmd": np.full_like(log.time_s, 9.81), "rate_cmd_b": log.rate_b}
        write_flight(tmp_path / f"{number}.parquet", replace(log, **commands))
    console, shown = Console(), []
    told = nullcontext(lambda *words: shown.append(words))
    monkeypatch.setattr(console, "progress", lambda *_: told)
    accept = ["thrust_command_unit"]  # the thrust commands are only there because a log needs some
    flights = read_checked([tmp_path], CheckContext(), accept)
    result = fit_delta(CONFIG, PHYSICS, flights, tmp_path / "out", console)
    kept = json.loads((tmp_path / "out" / "delta.json").read_text())
    assert accept[0] in [one["fault"] for one in kept["findings"]]
    header = stamp(1, CONFIG.seed)
    assert {key: kept[key] for key in header} == header
    without, identified, with_delta = result.errors.values()
    assert result.identified is not None and without.position_m > 0.1
    assert with_delta.position_m < 0.3 * without.position_m
    assert with_delta.velocity_m_s < 0.4 * without.velocity_m_s
    assert with_delta.position_m < identified.position_m
    assert [row["iteration"] for row in result.curve] == [*range(0, 100, 2), 99]
    held_out = [row["held_out_m"] for row in result.curve]
    assert held_out[-1] == pytest.approx(with_delta.position_m, rel=1e-5)
    assert held_out[-1] < 0.5 * held_out[0] and len(shown) == len(held_out)
    stored = load_delta(tmp_path / "out" / "delta").arrays
    jax.tree.map(np.testing.assert_array_equal, stored, result.params)
    said = (tmp_path / "out" / "table.md").read_text()
    grid = errors_grid({"horizon_s": 0.6, **plain(result.errors)})
    assert said == f"{markdown(grid)}\n<!-- {stamp_text(header)} -->\n"
    assert "| point mass with Delta Action Model |" in said
    with pytest.raises(ValueError, match=r"\(seed is 0 there, 7 here\); give another --out"):
        fit_delta(replace(CONFIG, seed=7), PHYSICS, flights, tmp_path / "out", console)


def test_a_network_learns_a_push_that_is_in_no_model():
    """As many windows are held out as are fitted: the errors of both are one program."""
    nominal, config = nominal_model(PHYSICS), replace(CONFIG, iterations=30)
    logs = fly(nominal, 8, extra_b=push)
    parts = (cut_windows(logs[k::2], config.horizon_s, config.stride_s) for k in (0, 1))
    found = fit_network(config, partial(replay_point_mass, nominal), *parts)
    without, with_delta = found.errors.values()
    assert without.position_m > 0.1 and with_delta.position_m < 0.5 * without.position_m
    assert [row["iteration"] for row in found.curve] == list(range(30))
    assert found.curve[-1]["held_out_m"] == pytest.approx(with_delta.position_m, rel=1e-5)


class Record(NamedTuple):
    """Windows that were flown."""

    pos_w: np.ndarray
    vel_w: Any = None


def test_a_replay_is_held_against_the_record_of_its_own_time():
    """The record itself has no error; one that is off by 3 and 4 has that of a distance of 5."""
    record = Record(*np.random.default_rng(0).normal(size=(2, 4, 6, 3)))
    config = FitConfig(velocity_weight=0.5, size_weight=0.25)

    def flown(off_m, off_m_s, correction):
        move = np.array([3.0, 0.0, 4.0])
        pos_w, vel_w = record.pos_w[:, 1:] + off_m * move, record.vel_w[:, 1:] + off_m_s * move
        return lambda windows, delta: (pos_w, vel_w, np.full((4, 5, 3), correction))

    for change, loss in (((0, 0, 0), 0), ((1, 0, 0), 5), ((0, 1, 0), 2.5), ((0, 0, 2), 3)):
        found = _loss(config, flown(*change), record, None)
        assert found == pytest.approx(loss, abs=1e-3)
    for error, size in zip(window_errors(flown(1, 2, 0), record, None), (5, 10), strict=True):
        np.testing.assert_allclose(error, np.full(4, size), rtol=1e-5)


def test_the_steps_of_a_descent_become_small():
    seen = []
    windows = Record(np.random.default_rng(0).normal(size=(64, 1)))
    loss = lambda x, batch: ((x - batch.pos_w) ** 2).mean()  # noqa: E731
    config = FitConfig(batch=4, rate=0.1)
    _descend(config, loss, np.float32(0.5), windows, 60, lambda _, x: seen.append(float(x)))
    steps = np.abs(np.diff(seen))
    assert steps[-3:].max() < 0.02 * steps[:3].max()


def test_flight_logs_are_found_once_and_without_any_nothing_is_written(tmp_path, capsys):
    assert run(f"delta {tmp_path} --out {tmp_path / 'out'}") == 2
    assert "no flight logs in" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    (tmp_path / "a").mkdir()
    for name in ("0.parquet", "1.parquet", "2.csv"):
        (tmp_path / name).touch()
    twice = [tmp_path, tmp_path / "a" / ".." / "0.parquet"]
    assert len(flight_files(twice)) == 3, "a flight that is named twice counts once"


QUAD = QuadrotorConfig(load_vehicle("reference"))
SLOWER = QuadrotorConfig(replace(with_lag(QUAD.vehicle, 0.05), name="other"))


@pytest.mark.parametrize(
    ("dynamics", "missing"),
    [(PHYSICS, "action_y"), (PHYSICS, "decisions"), (QUAD, "policy_step"), (QUAD, "cmd_thrust")],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_flights_without_what_a_fit_needs_are_refused(tmp_path, dynamics, missing):
    for i, log in enumerate(fly(nominal_model(PHYSICS), 2, seconds=1.5)):
        extra = {name: column for name, column in log.extra.items() if name != missing}
        if missing == "decisions":
            extra["policy_step"] = np.zeros(len(log.time_s))
        given = {"thrust_cmd": np.full_like(log.time_s, 9.81), "rate_cmd_b": log.rate_b}
        if missing == "cmd_thrust":
            given = {"rotor_speed": np.full((len(log.time_s), 4), 900.0)}
        write_flight(tmp_path / f"{i}.parquet", replace(log, extra=extra, **given))
    flights = read_checked([tmp_path], CheckContext(), list(FAULTS))
    with pytest.raises(ValueError, match=r"record (longer )?flights with suite collect"):
        fit_delta(FitConfig(), dynamics, flights, tmp_path / "out", Console())
    log = flights.logs[0]
    rates = replace(log, extra={"action_thrust": log.time_s, "policy_step": log.time_s})
    with pytest.raises(ValueError, match="its policy commands thrust and body rates"):
        log_decisions(rates)


def test_a_fault_that_the_network_would_learn_stops_the_fit(tmp_path, capsys):
    """It is found in the log, or was by its import."""
    doubt = Finding("doubt", "motors", "6 motors turn", "motor_count", 6.0, 0.97, "none")
    for i, log in enumerate(fly(nominal_model(PHYSICS), 2, seconds=1.5)):
        pos_w = log.pos_w * [1.0, -1.0, 1.0]
        given = {"thrust_cmd": np.full_like(log.time_s, 9.81), "rate_cmd_b": log.rate_b}
        about = {"findings": [doubt._asdict()] if i else [], "vehicle": f"drone {i}"}
        write_flight(tmp_path / f"{i}.parquet", replace(log, pos_w=pos_w, about=about, **given))
    assert run(f"delta {tmp_path} --out {tmp_path / 'out'}") == 2
    said = capsys.readouterr().err
    assert "would be wrong" in said and "--accept motor_count position_axes" in said
    assert not (tmp_path / "out").exists()


def test_flights_of_another_vehicle_than_the_corrected_one_warn(tmp_path, capsys, monkeypatch):
    for i, log in enumerate(fly(nominal_model(PHYSICS), 2, seconds=1.5)):
        given = {"thrust_cmd": np.full_like(log.time_s, 9.81), "rate_cmd_b": log.rate_b}
        about = {"vehicle": "reference"}
        write_flight(tmp_path / f"{i}.parquet", replace(log, about=about, **given))

    def cut(*_):
        raise WorkFailed("far enough")

    monkeypatch.setattr("suite.delta.quadrotor.cut_quadrotor_windows", cut)
    command = f"delta {tmp_path} --model quad --out {tmp_path / 'out'} --accept {' '.join(FAULTS)}"
    for vehicle, warns in (("crazyflie21", True), ("reference", False)):
        assert run(f"{command} --vehicle {vehicle}") == 1
        said = capsys.readouterr().err
        assert ("the log names the vehicle 'reference'" in said and vehicle in said) == warns


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
    crash = replace(fly(nominal_model(PHYSICS), 1, seconds=0.8)[0], name="crash")
    kept, words = long_enough([*logs, crash], 1.0)
    assert [log.name for log in kept] == [log.name for log in logs]
    assert words == ["crash: left out, it lasts 0.77 s and a window 1 s"]
    assert long_enough([logs[0], crash], 1.0) == ([logs[0], crash], [])


def test_a_fit_that_diverges_fails_and_writes_nothing(logs, tmp_path, monkeypatch):
    """A checkpoint that is not finite would be found at the next command only."""

    def diverged(*_):
        errors = {"point_mass": ReplayErrors(0.2, 0.2), "delta_action": ReplayErrors(0.2, np.nan)}
        return DeltaFit({}, errors, [])

    monkeypatch.setattr("suite.delta.run.fit_point_mass", diverged)
    with pytest.raises(WorkFailed, match="the fit diverged"):
        fit_delta(CONFIG, PHYSICS, CheckedFlights(logs), tmp_path / "out", Console())
    assert not (tmp_path / "out").exists()


def corrects(fitted, flown, rate_hz=15.0):
    """Check a run's dynamics against those that a checkpoint of 15 Hz has, as JSON has them."""
    kept = json.loads(json.dumps(plain({"rate_hz": 15.03, **describe_dynamics(fitted)})))
    check_corrects(kept, flown, rate_hz, Path("runs/delta/delta"))


RACE = race().physics
DRAGS = "drag 0.45 0.45 1.1 1/s.* this run's has .*drag 0.45 0.45 0.45 1/s.*--recipe"


def test_other_ranges_with_the_same_middle_and_another_name_of_the_vehicle_do_not_count():
    corrects(RACE, replace(RACE, drag=(0.0, 0.9), lag_std=0.0))
    corrects(QUAD, replace(QUAD, vehicle=replace(QUAD.vehicle, name="mine"), mass_std=0.0))


@pytest.mark.parametrize(
    ("fitted", "flown", "rate_hz", "words"),
    [
        (RACE, race_paper().physics, 15.0, DRAGS),
        (RACE, replace(RACE, action_delay=(0.5, 1.5)), 15.0, "delay 1 decisions; take"),
        (RACE, RACE, 30.0, "with 15 decisions a second, and this run has 30: .*--finetune .*=15"),
        (QUAD, SLOWER, 15.0, "another vehicle than 'other'; take its --vehicle"),
        (QUAD, PHYSICS, 15.0, "corrects --model quad, .* point"),
        (RACE, QUAD, 15.0, "corrects --model point, .* quad"),
    ],
)
def test_other_dynamics_or_another_rate_are_refused(fitted, flown, rate_hz, words):
    with pytest.raises(ValueError, match=words):
        corrects(fitted, flown, rate_hz)


def test_a_model_that_does_not_name_its_dynamics_is_refused():
    with pytest.raises(ValueError, match="lacks plant, rate_hz of the fit"):
        check_corrects({"model": "point"}, RACE, 15.0, Path("runs/delta"))


def test_what_is_advised_for_another_rate_is_accepted():
    """A new rate keeps the delay in seconds, but the model was fitted to one in decisions."""
    recipe = quick()
    fit = json.loads(json.dumps(plain({"rate_hz": 30.02, **describe_dynamics(recipe.physics)})))
    with pytest.raises(ValueError, match="--set") as refused:
        check_corrects(fit, recipe.physics, recipe.spec.rate_hz, Path("runs/delta"))
    advised = with_changes(recipe, str(refused.value).partition("--set ")[2].split())
    check_corrects(fit, advised.physics, advised.spec.rate_hz, Path("runs/delta"))
