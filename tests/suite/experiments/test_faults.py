"""Injected faults: every format brings a good flight back, and what is found is counted."""

from dataclasses import replace

import numpy as np
import pytest

from eval.importers import import_log
from eval.logs.faults.reading import readings_in
from eval.logs.flight_log import write_flight
from eval.quadrotor.vehicle_file import save_vehicle
from suite.common.console import Console
from suite.experiments import faults
from suite.experiments.injected.flights import flight_signals
from suite.experiments.injected.kinds import KINDS, inject
from suite.experiments.injected.writers import WRITERS
from suite.experiments.study.cache import Workspace
from tests.support import known_flight
from tests.support.imported import near
from tests.support.vehicles import PLAIN


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    truth = known_flight.fly(np.arange(0.0, 10.0, 0.01))
    log = known_flight.log(10.0)
    return write_flight(tmp_path_factory.mktemp("judged") / "known.parquet", log), log, truth


@pytest.mark.parametrize("format", WRITERS)
def test_a_written_flight_comes_back(tmp_path, judged, format):
    _, log, truth = judged
    parts = flight_signals(log, PLAIN, np.random.default_rng(0))
    written = WRITERS[format](tmp_path, parts)
    back, findings = import_log(written.path, format, written.options)
    assert not [f for f in findings if f.fault and f.status in ("corrected", "doubt")]
    rows = known_flight.fly(truth.time[0] + back.time_s)
    near(back.rate_b, rows.rate, 0.3)
    near(back.rotor_speed, rows.motor, 40.0)


def test_a_wrong_order_of_motors_holds_for_speeds_and_commands_and_the_printed_one_corrects_it(
    judged, tmp_path
):
    _, log, _ = judged
    parts = flight_signals(log, PLAIN, np.random.default_rng(0))
    faulty = inject(KINDS["motors 3 and 4 swapped"], parts, PLAIN)
    for name in ("motor", "pwm"):
        np.testing.assert_array_equal(faulty[name], parts[name][:, [0, 1, 3, 2]])
    parts["motor"] = parts["motor"][:, [1, 3, 2, 0]]
    written = WRITERS["px4"](tmp_path, parts)
    options = replace(written.options, vehicle=PLAIN, fix=False)
    _, findings = import_log(written.path, "px4", options)
    (found,) = (f for f in findings if f.fault == "motor_order")
    _, findings = import_log(written.path, "px4", replace(options, read=readings_in(found.fix)))
    assert "motor_order" not in {f.fault for f in findings}


@pytest.mark.parametrize("name", KINDS)
def test_a_fault_goes_into_every_log_with_the_signals_that_it_needs(name, judged):
    """A real log has few signals; a signal that is missing must not end the page."""
    kind, (_, log, _) = KINDS[name], judged
    parts = flight_signals(log, PLAIN, np.random.default_rng(0))
    while spare := [n for n in parts if n != "time" and kind.fits(set(parts) - {n})]:
        del parts[spare[0]]
    faulty = inject(kind, parts, PLAIN)
    assert len({len(values) for values in faulty.values()}) == 1


def test_commands_that_are_logged_early_are_cut_not_wrapped_around(judged):
    _, log, _ = judged
    parts = flight_signals(log, PLAIN, np.random.default_rng(0))
    faulty = inject(KINDS["commands act 150 ms later"], parts, PLAIN)
    np.testing.assert_array_equal(faulty["cmd_rate"], parts["cmd_rate"][15:])
    np.testing.assert_array_equal(faulty["rate"], parts["rate"][:-15])


def test_answers_are_kept_for_each_case_and_an_incomplete_last_line_is_dropped(
    tmp_path, monkeypatch
):
    made = []
    monkeypatch.setattr(faults, "_check", lambda case, **_: [made.append(case) or "refused"])
    cases = [faults.Case("", "real", tmp_path / "log", number) for number in range(3)]
    (tmp_path / "log").write_text("a log")
    place = (faults.Config(), tmp_path, Console(), Workspace(tmp_path, tmp_path))
    assert faults._check_cases(cases, *place) == dict.fromkeys(cases, "refused")
    (path,) = tmp_path.glob("checked-*.jsonl")
    path.write_text(path.read_text()[:-3])
    for _ in range(2):
        assert faults._check_cases(cases, *place) == dict.fromkeys(cases, "refused")
    assert made == [*cases, cases[-1]]
    (tmp_path / "log").write_text("another log of this name")
    faults._check_cases(cases, *place)
    assert made == [*cases, cases[-1], *cases]


def test_without_a_long_flight_the_page_is_refused_and_a_changed_vehicle_file_flies_again(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(faults, "collect", lambda *args: {"flights": []})
    config = faults.Config(vehicle=str(tmp_path / "mine.toml"))
    for mass in (PLAIN.mass, 1.1 * PLAIN.mass):
        save_vehicle(replace(PLAIN, mass=mass), config.vehicle, "")
        with pytest.raises(ValueError, match="mine.toml: no flight .*4 s"):
            faults.document(config, Workspace(tmp_path, tmp_path), Console())
    with pytest.raises(ValueError, match="mine.toml"):
        faults.document(replace(config, clean=300), Workspace(tmp_path, tmp_path), Console())
    assert len(list(tmp_path.glob("faults-*"))) == 3


def test_outcomes_are_counted_by_name(judged):
    path, *_ = judged
    cases = {
        "named": faults.Case("quaternion xyzw", "px4", path, 0),
        "silent": faults.Case("gyro in deg/s", faults.FLIGHT_LOG, path, 0),
    }
    (answer,) = faults._check(cases["named"], "racer5", 1)
    assert faults._outcome(cases["named"], answer) == "named"
    assert faults._outcome(cases["silent"], []) == "silent"
    assert faults._outcome(cases["silent"], "refused for a reason") == "refused"
    assert faults._reported_faults(answer) and not faults._reported_faults([])
    grid = faults._kinds_grid([(cases["named"], answer)])
    assert "1 (100.0%)" in {cell.text for cell in grid.rows[-1]}
