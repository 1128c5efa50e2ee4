"""Mistakes that a diagnosis has made before: each on small flights, by force and torque."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.diagnose import diagnose
from tests.support.diagnosis_flights import fly_all
from tests.support.real_flights import VEHICLE, flights

FALL = 0.08
"""Of the battery's voltage [V/s]."""


def found_in(logs):
    """Return the verdict, and what is named with what could stand in its place."""
    found = diagnose(logs, VEHICLE, by="views")
    names = {name.candidate.name: set(name.rivals) for _, name in found.named}
    return found.label, names, found


def pushed(extra, seed, duration_s=6.0):
    """Return flights with an acceleration that no effect of the catalogue makes."""
    return fly_all(
        [VEHICLE] * 4, range(seed, seed + 4), duration_s, 3.0, motors=True, extras=[extra] * 4
    )


@pytest.mark.slow
def test_a_battery_that_sags_with_its_voltage_is_named_with_its_size():
    logs = [
        replace(log, voltage=16.8 - FALL * (log.time_s - log.time_s[0]))
        for log in flights(4, seed=6, duration_s=12.0, battery_sag=(0.006, 0.0))
    ]
    label, names, found = found_in(logs)
    assert label == "named" and set(names) == {"battery_sag"}
    assert found.vehicle.effects["battery_sag"].per_volt == pytest.approx(0.006 / FALL, rel=0.1)


def test_a_drag_to_one_side_is_no_wind():
    def forwards(motion, t):
        ahead = motion.rot_w[:, 0]
        return -0.5 * max(float(motion.vel_w @ ahead), 0.0) * ahead

    label, names, _ = found_in(pushed(forwards, 20, 4.0))
    assert label in ("partly", "unknown") and "constant_wind" not in names


@pytest.mark.slow
def test_a_hysteresis_outside_the_catalogue_is_no_thrust_alone():
    def stuck(motion, t):
        return (2.0 if motion.vel_w[2] > 0.0 else -1.0) * motion.rot_w[:, 2]

    label, names, found = found_in(pushed(stuck, 40, 12.0))
    assert label in ("partly", "unknown"), names
    assert found.verdict.where is not None


def test_a_force_that_nothing_explains_is_not_no_gap():
    """Three flights of 6 s are too few to fit a regression to it, and the search finds nothing."""

    def by_place(motion, t):
        return 1.5 * np.array([np.sin(1.5 * motion.pos_w[0]), np.cos(1.5 * motion.pos_w[1]), 0.0])

    label, names, found = found_in(pushed(by_place, 20))
    assert (label, names) == ("unknown", {})
    assert found.verdict.share_left > 0.9 and "m/s^2 beyond the noise" in found.verdict.where
    main = found.main
    shown = main.source.series(main.search)
    assert shown.label.partition("body ")[2][0] in "xy", "the picture shows where the error is"


@pytest.mark.slow
def test_one_effect_is_named_without_a_second_small_one_but_with_what_looks_alike():
    label, names, _ = found_in(flights(4, seed=11, speed=4.0, blade_flapping=(2e-6,)))
    assert label == "named" and len(names) == 1
    assert "blade_flapping" in {*names, *next(iter(names.values()))}
    _, names, _ = found_in(flights(4, seed=12, speed=1.0, hidden={"mass_offset": (0.08,)}))
    assert {"mass_offset", "thrust_scale"} <= {*names, *set().union(*names.values())}
