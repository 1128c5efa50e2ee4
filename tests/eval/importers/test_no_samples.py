"""Cells that hold no sample (placeholders, outliers, repeats): left out before the checks."""

from types import SimpleNamespace

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.cleaning import without_repeats
from eval.importers.formats import FORMATS
from eval.importers.formats.table import unwrapped
from eval.importers.options import ImportOptions
from eval.importers.signals import Recording, Signal, collect
from eval.logs.faults.check import check_log
from eval.logs.faults.drive.commands import has_both_signs
from eval.logs.faults.position import jumps_of
from eval.logs.flight_log import read_flight
from tests.support import known_flight
from tests.support.imported import flight, text, write
from tests.support.marks import more


def imported(folder, change, fix=True):
    """Import the flight whose parts were changed; return its log and findings that are open."""
    parts = flight(100.0, 8.0, 1.0)
    change(parts)
    path = write(folder / "flight.csv", parts)
    log, findings = import_log(path, None, ImportOptions(partial=True, trim=False, fix=fix))
    return log, findings, [f for f in findings if f.status == "doubt"]


@pytest.mark.parametrize("number", [0.0, more(-9999.0)])
@pytest.mark.parametrize("kept", ["most", "every fourth"])
def test_a_number_that_stands_for_no_position_is_an_empty_cell(tmp_path, number, kept):
    is_missing = np.random.default_rng(0).random(800) < 0.02
    if kept == "every fourth":
        is_missing = np.arange(800) % 4 > 0
    log, findings, doubts = imported(
        tmp_path, lambda parts: parts["pos"].__setitem__(is_missing, number)
    )
    assert not doubts and f"{is_missing.sum()} samples are {number:g}, " in text(
        findings, "position"
    )
    assert np.abs(log.pos_w[np.isfinite(log.pos_w).all(axis=1)]).max() < 50.0


@pytest.mark.parametrize("still", ["rest at zero", "flights from one start", "centimetres"])
def test_a_position_that_recurs_is_none(still):
    pos = known_flight.fly(np.arange(0.0, 6.0, 0.01)).pos
    pos = pos - pos[0]
    if still == "rest at zero":
        pos = np.concatenate([np.zeros((200, 3)), pos])
    elif still == "flights from one start":
        pos = np.concatenate([pos, pos, pos])
    else:
        pos = np.round(0.05 * pos, 2)
    signals, findings = collect({"pos": (0.01 * np.arange(len(pos)), pos)}, "log")
    assert len(signals["pos"].value) == len(pos) and not findings


@pytest.mark.parametrize("fix", [True, False])
def test_a_lone_outlier_hides_nothing_from_the_checks(tmp_path, fix):
    def change(parts):
        parts["pos"][[0, 300, 302]] += [[1000.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 90.0]]

    log, findings, doubts = imported(tmp_path, change, fix)
    assert {f.fault for f in doubts} <= {"position_jump"}
    assert not fix or (len(log.time_s) == 797 and "3 samples jump" in text(findings, "position"))


def test_outliers_of_a_log_are_its_only_fault(tmp_path):
    parts = flight(100.0, 8.0, 1.0)
    parts["pos"][[150, 300, 450, 600]] += [0.0, 100.0, 0.0]
    log = read_flight(write(tmp_path / "flight.csv", parts))
    assert {f.fault for f in check_log(log)[0] if f.status == "doubt"} == {"position_jump"}


@pytest.mark.parametrize("in_metres", [True, False])
def test_the_neighbours_of_outliers_do_not_jump(in_metres):
    time = np.arange(0.0, 6.0, 0.01)
    pos, bad = known_flight.fly(time).pos * 2.0, [100, 102, 103, 200, 250, 251]
    pos[bad] = -50.0
    assert np.flatnonzero(jumps_of(time, pos, in_metres)).tolist() == bad


def test_noise_without_neighbours_has_no_jumps():
    pos = np.random.default_rng(0).uniform(-100.0, 100.0, (60, 3))
    assert not jumps_of(0.01 * np.arange(60), pos, in_metres=True).any()


def test_repeats_of_position_and_attitude_are_left_out_each_at_its_times():
    time_s = np.arange(0.0, 4.0, 0.01)
    wave = np.stack([np.cos(time_s), np.sin(time_s), 0.0 * time_s, 0.0 * time_s], axis=1)
    held = wave[np.arange(400) // 2 * 2]
    poses = {"quat": Signal(time_s, held), "pos": Signal(time_s + 0.003, held[:, :3])}
    left = without_repeats(Recording("log", poses))
    assert [len(signal.time_s) for signal in left.signals.values()] == [200, 200]
    assert [finding.signal for finding in left.findings] == ["attitude", "position"]


@pytest.mark.parametrize("fix", [True, False])
def test_a_pose_that_is_held_in_fast_rows_is_as_one_with_empty_cells(tmp_path, fix):
    def change(parts):
        for name in ("pos", "quat"):
            parts[name] = parts[name][np.arange(800) // 5 * 5]

    log, _, doubts = imported(tmp_path, change, fix)
    assert {f.fault for f in doubts} <= {"clock_offset"} and (not fix or len(log.time_s) == 160)


@pytest.mark.parametrize(
    ("bits", "per_s", "unit"), [(32, 1e6, 1.0), (32, 1e6, 1e-6), (16, 1e3, 1.0), (16, 1e3, 1e-3)]
)
def test_a_counter_that_starts_again_is_one_clock(bits, per_s, unit):
    time_s = np.arange(0.0, 150.0, 0.01)
    count = np.round(per_s * time_s) + 2.0**bits - 3.0 * per_s
    found, (finding,) = unwrapped(np.append(np.nan, count % 2.0**bits * unit))
    np.testing.assert_allclose(found[1:], count * unit, rtol=1e-12)
    assert f"its {bits}-bit counter starts again {1 if bits == 32 else 3} times" in finding.evidence
    two_flights = np.concatenate([count, count - 40.0 * per_s]) * unit
    assert not unwrapped(two_flights)[1] and not unwrapped(count[::-1] * unit)[1]


@pytest.mark.parametrize("hz", [100.0, more(400.0)])
def test_a_gyro_that_is_the_rate_command_is_named_and_moves_no_clock(tmp_path, hz):
    parts = flight(hz, 6.0, 1.0)
    log, findings = import_log(write(tmp_path / "good.csv", parts))
    assert not [f for f in [*findings, *check_log(log)[0]] if f.is_open]
    parts["rate"] = parts["cmd_rate"]
    log, findings = import_log(write(tmp_path / "log.csv", parts))
    (doubt,) = (f for f in findings if f.status == "doubt")
    assert doubt.is_open and "equals the rate command in 100 %" in doubt.evidence
    assert not {"clock_offset"} & {f.fault for f in findings}
    assert doubt.evidence in {f.evidence for f in check_log(log)[0]}


def test_a_thrust_without_gravity_cuts_no_flight_and_gets_its_gravity(tmp_path):
    parts = flight(100.0, 8.0, 1.0)
    thrust = parts["cmd_thrust"].copy()
    parts["cmd_thrust"] -= 9.81
    assert has_both_signs(parts["cmd_thrust"][:, 0]) and not has_both_signs(thrust[:, 0])
    log, findings = import_log(write(tmp_path / "flight.csv", parts))
    (found,) = (f for f in findings if f.status in ("doubt", "corrected"))
    assert found.fix == "--read cmd_thrust=plus-gravity" and len(log.time_s) == 800
    assert "no signal shows when the motors run" in text(findings, "ground")
    np.testing.assert_allclose(log.thrust_cmd, thrust[:, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("signals", "said"),
    [
        ({"gyro": np.zeros((9, 3))}, "unknown signal of the format 'mine' 'gyro'"),
        ({"motors": np.zeros((9, 4))}, "Did you mean 'motor'"),
        ({"pos": np.zeros((9, 2))}, r"'pos' of shape \(9, 2\), not \(9, 3\)"),
        ({"voltage": np.zeros(9)}, r"'voltage' of shape \(9,\), not \(9, 1\)"),
        (None, "reads a NoneType, not a Recording"),
    ],
)
def test_signals_of_another_packages_format_that_would_be_ignored_are_refused(
    tmp_path, monkeypatch, signals, said
):
    recording = signals and Recording(
        "file", {name: Signal(np.arange(9.0), value) for name, value in signals.items()}
    )
    mine = SimpleNamespace(
        SUMMARY="", detect=lambda head, options: True, read=lambda path, options: recording
    )
    for held in ("_entries", "_values"):
        monkeypatch.setitem(getattr(FORMATS, held), "mine", mine)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ValueError, match=said):
        import_log(tmp_path / "file", "mine")
