"""Lag, drag and delay found again, and a residual learned, on flights whose truth is known."""

from contextlib import nullcontext
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from eval.logs.flight_log import write_flight
from policies.formats.policy_file import load_delta
from suite.common.console import Console
from suite.delta.fit import FitConfig, _descend, _loss, identify, window_errors
from suite.delta.replay import PointMassModel, nominal_model
from suite.delta.run import errors_grid, fit_delta
from suite.delta.windows import cut_windows
from suite.train.config import PointMassConfig
from tests.support.point_mass_flights import fly
from tracks.common.files import plain
from tracks.common.grid import markdown


class Record(NamedTuple):
    """Windows that were flown."""

    pos_w: np.ndarray
    vel_w: Any = None


PHYSICS = PointMassConfig(drag=(0.3, 0.3), drag_up=(0.3, 0.3), action_delay=(0.5, 0.5))
CONFIG = FitConfig(horizon_s=0.6, stride_s=0.3, iterations=100, batch=32, rate=1e-2, held_out=0.5)


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

    def descend(config, loss, start, windows, iterations, watch):
        taken.append(iterations)
        return start

    monkeypatch.setattr("suite.delta.fit._descend", descend)
    for iterations in (2, 9):
        identify(FitConfig(iterations=iterations), PHYSICS, nothing)
    assert taken == [1, 3]


def push(vel_b, action_b):
    """A vehicle that gives nine tenths of what is asked and is pushed to its left."""
    return -0.1 * action_b + np.array([0.0, 0.8, -0.5], np.float32)


def test_a_delta_action_cuts_the_error_of_a_perturbed_point_mass(tmp_path, monkeypatch):
    """As many flights are held out as are fitted: the errors of both are one program."""
    for number, log in enumerate(fly(nominal_model(PHYSICS), 8, extra_b=push)):
        commands = {"thrust_cmd": np.full_like(log.time_s, 9.81), "rate_cmd_b": log.rate_b}
        write_flight(tmp_path / f"{number}.parquet", replace(log, **commands))
    console, shown = Console(), []
    told = nullcontext(lambda *words: shown.append(words))
    monkeypatch.setattr(console, "progress", lambda *_: told)
    result = fit_delta(CONFIG, PHYSICS, [tmp_path], tmp_path / "out", console)
    without, identified, with_delta = result.errors.values()
    assert result.identified is not None
    assert without.position_m > 0.1
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
    assert said == markdown(grid) and "| point mass with Delta Action Model |" in said


def test_a_replay_is_held_against_the_record_of_its_own_time():
    """The record itself has no error; one that is off by 3 and 4 has that of a distance of 5."""
    rng = np.random.default_rng(0)
    record = Record(*rng.normal(size=(2, 4, 6, 3)))
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
