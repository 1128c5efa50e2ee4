"""Logs cut into windows: what is held, what is seen, and what a hole does."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.data.windows import (
    BURN_IN_S,
    LENGTH_S,
    SLICES,
    STEPS,
    cut,
    take,
)
from suite.diagnose.thresholds import Thresholds
from tests.support.diagnosis_flights import fly
from tests.support.vehicles import PLAIN


def test_windows_hold_the_rows_and_commands_of_their_time():
    log = fly(PLAIN, 0, duration_s=4.0)
    windows, warnings = cut([log], PLAIN, False)
    assert windows is not None and not warnings
    assert len(windows.flight) == 3 and np.diff(windows.start_s).min() >= LENGTH_S - 1e-9
    burn_in = windows.burn_in_rate_b.shape[1]
    np.testing.assert_allclose(windows.edge_s[:, [0, burn_in, -1]], [[-BURN_IN_S, 0, LENGTH_S]] * 3)
    steps = windows.rotor_speed.shape[1]
    assert steps == STEPS[0] and windows.edge_s.shape[1] == burn_in + steps + 1
    assert np.diff(windows.edge_s).min() >= 0.0
    row = int(np.searchsorted(log.time_s, windows.start_s[1] - 1e-9))
    np.testing.assert_array_equal(windows.pos_w[1], log.pos_w[row])
    np.testing.assert_array_equal(windows.row_pos_w[1][7], log.pos_w[row + 7])
    assert log.thrust_cmd is not None
    now = int(np.searchsorted(windows.command_s[1], -1e-9))
    assert windows.command[1, now, 0] == log.thrust_cmd[row]
    held = np.diff(windows.command_s[1, now : now + 2]) * windows.command[1, now]
    np.testing.assert_allclose(np.diff(windows.command_sum[1, now : now + 2], axis=0)[0], held)
    chosen = take(windows, windows.start_s > 1.0)
    np.testing.assert_array_equal(chosen.pos_w, windows.pos_w[1:])


def test_few_shapes_hold_rows_of_every_rate():
    log = fly(PLAIN, 0, duration_s=2.0)
    shapes = {}
    for rate_hz in (50.0, 97.0, 140.0, 250.0, 310.0, 400.0, 990.0):
        rows = np.arange(0.0, 1.9, 1.0 / rate_hz)
        near = np.clip(np.searchsorted(log.time_s, rows), 0, len(log.time_s) - 1)
        arrays = {name: value[near] for name, value in vars(log).items()
                  if isinstance(value, np.ndarray) and len(value) == len(log.time_s)}  # fmt: skip
        windows, _ = cut([replace(log, **{**arrays, "time_s": rows})], PLAIN, False)
        assert windows is not None
        shape = (windows.edge_s.shape[1], windows.command_s.shape[1])
        shapes.setdefault(shape, []).append(rate_hz)
    assert shapes == {
        (144 + 512 + 1, 192): [50.0, 97.0],
        (144 + 704 + 1, 192): [140.0],
        (144 + 512 + 1, 1536): [250.0, 400.0, 990.0],
        (144 + 704 + 1, 1536): [310.0],
    }


def test_what_is_an_input_or_derived_is_no_measurement():
    log = replace(fly(PLAIN, 0, duration_s=2.0, motors=True), velocity_derived=True)
    for rotor_input in (False, True):
        windows, _ = cut([log], PLAIN, rotor_input)
        assert windows is not None
        seen = windows.valid.any(axis=(0, 1))
        assert seen[SLICES["rotor speed"]].all() != rotor_input
        assert bool(windows.rotor_speed.any()) == rotor_input
        assert not seen[SLICES["velocity"]].any() and seen[SLICES["position"]].all()


def test_a_hole_is_stepped_over_and_a_log_of_holes_is_named():
    log = fly(PLAIN, 0, duration_s=4.0)
    kept = (log.time_s < 0.8) | (log.time_s > 1.15)
    arrays = {name: value[kept] for name, value in vars(log).items()
              if isinstance(value, np.ndarray) and len(value) == len(kept)}  # fmt: skip
    holed = replace(log, **arrays)
    windows, _ = cut([holed], PLAIN, False)
    assert windows is not None and windows.start_s.min() > 1.1
    assert windows.start_s.min() > 1.15 + BURN_IN_S, "the rotors follow commands before it"
    none, warnings = cut([holed], PLAIN, False, limits=Thresholds(longest_hole_s=1e-3))
    assert none is None and warnings == [f"{log.name}: no stretch of 1.3 s without a hole"]


@pytest.mark.parametrize("rotor_input", [False, True])
def test_what_drives_must_be_known_all_the_way(rotor_input):
    """A row is there, but not what drives: between two that say it, it would be made up."""
    log = fly(PLAIN, 0, duration_s=4.0, motors=True)
    name = "rotor_speed" if rotor_input else "rate_cmd_b"
    lost = np.array(getattr(log, name))
    lost[(log.time_s > 0.8) & (log.time_s < 1.15)] = np.nan
    windows, _ = cut([replace(log, **{name: lost})], PLAIN, rotor_input)
    assert windows is not None and windows.start_s.min() > 1.15 + BURN_IN_S
    other = cut([replace(log, **{name: lost})], PLAIN, not rotor_input)[0]
    assert other is not None and other.start_s.min() < 0.5


def test_of_many_stretches_as_many_as_allowed_are_spread_over_the_flights():
    logs = [fly(PLAIN, seed, duration_s=8.0) for seed in (0, 1)]
    every, _ = cut(logs, PLAIN, False)
    some, (said,) = cut(logs, PLAIN, False, limits=Thresholds(most_windows=4))
    assert said == f"4 stretches of 1 s, evenly spread, are used of {len(every.flight)}"
    assert some.flight.tolist() == [0, 0, 1, 1]
    assert some.start_s[0] == every.start_s[0] and some.start_s[-1] == every.start_s[-1]
    second, _ = cut(logs, PLAIN, False, only=[1])
    assert set(second.flight.tolist()) == {1}
