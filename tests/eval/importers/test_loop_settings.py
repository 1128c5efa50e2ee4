"""Settings of a firmware's rate loop in a log, compared with those of the vehicle file."""

from dataclasses import replace

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.formats import betaflight, px4
from eval.importers.options import ImportOptions
from eval.logs.faults.check import CheckContext, check_log
from eval.logs.faults.vehicle import LOOP, check_controller
from eval.quadrotor.loops import betaflight as betaflight_loop
from eval.quadrotor.loops import px4 as px4_loop
from tests.support import foreign_logs as made
from tests.support.vehicles import PLAIN

LOGGED = {"MC_ROLLRATE_P": float(np.float32(0.12)), "THR_MDL_FAC": 0.3, "MC_YAWRATE_I": "damaged"}


def with_loop(**settings):
    loop = px4_loop.Settings(**settings)
    return replace(PLAIN, controller=replace(PLAIN.controller, kind="px4", settings=loop))


@pytest.fixture
def imported(tmp_path, monkeypatch):
    """Import a ULog file by a vehicle file, with the parameters LOGGED, and changes of them."""
    path, load, changes = made.write_ulog(tmp_path / "log.ulg", span=(0, 4)), px4._load, {}

    def loaded(path):
        log = load(path)
        log.initial_parameters.update(LOGGED)
        log.changed_parameters.extend((5_000_000, *each) for each in changes.items())
        return log

    monkeypatch.setattr(px4, "_load", loaded)

    def run(vehicle, **changed):
        changes.update(changed)
        return import_log(path, None, ImportOptions(vehicle=vehicle))

    return run


def of_loop(findings):
    return [finding for finding in findings if finding.signal == LOOP]


def test_another_setting_than_the_logs_is_a_doubt_until_the_vehicle_file_has_it(imported):
    log, findings = imported(with_loop(MC_ROLLRATE_P=0.15))
    (doubt,) = of_loop(findings)
    assert (doubt.status, doubt.fault, doubt.is_open) == ("doubt", "controller_settings", False)
    assert "MC_ROLLRATE_P is 0.12, in the vehicle file 0.15" in doubt.evidence
    assert doubt.fix == (
        "MC_ROLLRATE_P = 0.12, THR_MDL_FAC = 0.3 in [controller] of the vehicle file"
    )
    assert log.about["controller"] == {"kind": "px4", **dict(list(LOGGED.items())[:2])}
    (again,) = of_loop(check_log(log, CheckContext(with_loop(MC_ROLLRATE_P=0.12)))[0])
    assert "THR_MDL_FAC is 0.3" in again.evidence and "ROLL" not in again.evidence
    corrected = with_loop(MC_ROLLRATE_P=0.12, THR_MDL_FAC=0.3)
    (right,) = of_loop(check_log(log, CheckContext(corrected))[0])
    assert right.status == "ok"


def test_a_setting_that_changes_within_the_log_is_not_compared(imported):
    vehicle = with_loop(MC_ROLLRATE_P=0.2, THR_MDL_FAC=0.3)
    log, findings = imported(vehicle, MC_ROLLRATE_P=0.2, THR_MDL_FAC=0.3)
    assert log.about["controller"] == {"kind": "px4", "THR_MDL_FAC": 0.3}
    assert [finding.status for finding in of_loop(findings)] == ["ok"]


@pytest.mark.parametrize("value", [10**400, float("nan"), True, "0.2", None])
def test_metadata_that_are_no_settings_are_ignored(value):
    logged = {"kind": "px4", "MC_ROLLRATE_P": value, "__class__": 1.0}
    assert check_controller({"controller": logged}, with_loop()) == []


def test_a_loop_of_another_kind_is_a_note(imported):
    (note,) = of_loop(imported(PLAIN)[1])
    assert note.status == "note" and "'px4', that of the vehicle file of kind 'p'" in note.evidence


def test_many_settings_are_listed_shortly_and_the_fix_has_all(monkeypatch, imported):
    monkeypatch.setitem(LOGGED, "IMU_GYRO_CUTOFF", 60.0)
    monkeypatch.setitem(LOGGED, "MC_ROLLRATE_K", 1.2)
    (doubt,) = of_loop(imported(with_loop())[1])
    assert doubt.evidence.endswith("; and 1 more") and doubt.fix.count(" = ") == 4


def test_settings_of_betaflights_header_have_the_names_of_the_vehicle_file():
    box = betaflight.Blackbox.__new__(betaflight.Blackbox)
    box.header = {
        **{"rollPID": [45, 80, 40], "pitchPID": [47, 84, 46], "yawPID": [45, 80, 0]},
        **{"d_min": [30, 34, 0], "ff_weight": [120, 125, 120], "tpa_rate": 65},
        **{"gyro_lpf1_static_hz": 250, "gyro_lpf1_dyn_hz": [250, 500], "iterm_relax": 1},
        **{"dterm_lpf1_static_hz": 75, "dterm_lpf1_dyn_hz": [0, 0], "iterm_relax_cutoff": 15},
        **{"rc_smoothing_setpoint_cutoff": 0, "unknown": 3, "iterm_windup": "a"},
    }
    found, default = betaflight._controller(box), betaflight_loop.Settings()
    gains = {f"{term}_{axis}" for term in "pidf" for axis in ("roll", "pitch", "yaw")}
    assert found.keys() == gains | {"tpa_rate", "dterm_lpf1_static_hz", "iterm_relax_cutoff"}
    # This header has the defaults of Betaflight 4.4.
    assert found == {name: getattr(default, name) for name in found}
    box.header |= {"d_min": [0, 0, 0], "iterm_relax": 0}  # without D min, D is the header's
    assert betaflight._controller(box)["d_roll"] == 40.0
    box.header["d_min"] = [50, 34, 0]  # not below D: without effect
    found = betaflight._controller(box)
    assert (found["d_roll"], found["d_pitch"], found["d_yaw"]) == (40.0, 34.0, 0.0)
    assert betaflight._controller(box)["iterm_relax_cutoff"] == 0.0
    box.header = {}
    assert not betaflight._controller(box)
