"""Diagnoses by views, end to end: names, sizes, gaps, and what a black box could explain."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.diagnose import diagnose
from suite.diagnose.estimate.parameters import candidates
from suite.diagnose.evidence.moments import centred
from suite.diagnose.search.evaluation import Evaluation, NamedEffect
from suite.diagnose.sources.examine import contradicted
from suite.diagnose.sources.view_source import closed_share, fit_black_box, inputs_of
from tests.support.real_flights import VEHICLE, flights
from tests.support.vehicles import with_effects

DRAG = (0.4, 0.3, 0.2)


def test_a_drag_is_named_and_closes_what_any_model_could(by_views):
    assert by_views.label == "named" and by_views.warnings == []
    assert by_views.vehicle.effects["linear_drag"].coefficient[0] == pytest.approx(0.4, abs=0.05)
    force, left = by_views.findings[0], by_views.findings[0].remaining
    assert left.gap_details["closed"] > 0.8 > 0.3 * left.explainable
    assert force.after.rms < 0.6 * force.before.rms and force.removed(force.names) > 0.9
    assert len(by_views.flights.held_out) == 1
    # Moments of 2 s are drawn together: their errors are correlated.
    assert [one.before.together for one in by_views.findings] == [20, 40]


@pytest.mark.parametrize(("scale", "count"), [(0.9, 1), (1.0, 0)])
def test_a_thrust_that_the_force_view_excludes_is_contradicted(by_views, scale, count):
    force, space = by_views.findings[0].search, by_views.main.source.space
    (one,) = [c for c in candidates(space, False, ()) if c.name == "thrust_scale"]
    theta = space.array("start")
    theta[list(one.indices)] = scale
    evidence, at = force.judged.evidence, force.estimate._replace(theta=theta)
    block = evidence.linearise(at, one.indices)
    here = Evaluation(evidence, at, block)
    named = (NamedEffect(one, 0.001, 1.0),)
    torque = replace(force, named=named, last=here, judged=here)
    assert [name for name, _ in contradicted(force, torque)] == [one] * count


@pytest.mark.slow
def test_a_drag_of_the_file_makes_way_for_what_rotors_do_and_none_stands_for_another():
    hidden = {"rotor_drag": 7.8e-5, "translational_lift": 0.027, "inflow": 1.5e-4}
    logs = flights(4, speed=4.0, hidden={name: (value,) for name, value in hidden.items()})
    rivals, found = names(logs, with_effects(VEHICLE, linear_drag=((0.18, 0.18, 0.72),)))
    assert rivals == {name: set() for name in ("linear_drag", *hidden)}
    effects = found.vehicle.effects
    assert effects["linear_drag"].coefficient == pytest.approx((0, 0, 0), abs=0.1)
    for name, value in hidden.items():
        assert effects[name].coefficient == pytest.approx(value, rel=0.1)


def test_an_inertia_is_named_though_the_trim_of_each_flight_is_larger():
    logs = flights(4, seed=9, speed=4.0, inertia_scale=((0.8, 0.8, 0.8),))
    found = diagnose(logs, VEHICLE, by="views")
    assert [name.candidate.name for _, name in found.named] == ["inertia_scale"]
    assert found.vehicle.effects["inertia_scale"].scale == pytest.approx((0.8, 0.8, 0.8), abs=0.02)
    assert found.main.after.total > found.main.before.total  # with the flights' trims
    assert found.main.after.rms < found.main.before.rms  # without them
    assert found.main.after.energy.sum() < found.main.before.energy.sum()


@pytest.mark.slow
def test_a_slow_effect_is_no_noise_with_a_memory_however_long_the_flights():
    logs = flights(4, seed=6, duration_s=20.0, battery_sag=(0.004, 0.0))
    found = diagnose(logs, VEHICLE, by="views")
    ((_, name),) = found.named
    assert name.candidate.name == "battery_sag" and 0.8 < name.share < 1.0
    assert found.vehicle.effects["battery_sag"].rate == pytest.approx(0.004, rel=0.05)


def test_an_attitude_alone_shows_the_torque_as_finely_as_a_gyro():
    moved = flights(4, 5, 5.0, com_offset=((0.006, -0.002, 0.0),))
    lost, about = np.full_like(moved[0].rate_b, np.nan), {"partial": ["rate"]}
    without_gyro = [replace(log, rate_b=lost, about=about) for log in moved]
    found = diagnose(without_gyro, VEHICLE, by="views")
    assert [name.candidate.name for _, name in found.named] == ["com_offset"]


def test_a_black_box_explains_what_depends_on_the_motion_and_no_noise(by_views):
    force = by_views.findings[0].search
    fitted = force.last.evidence.flights
    inputs = np.concatenate([inputs_of(flight) for flight in fitted])
    flight = force.last.block.data.flight
    noise = np.random.default_rng(0).standard_normal((len(flight), 3))
    said = inputs @ fit_black_box(inputs, noise, flight)
    assert closed_share(noise, noise - said, flight).max() < 0.2
    real = 2.0 * inputs[:, [0, 1, 2]] + 0.1 * noise
    left = real - inputs @ fit_black_box(inputs, real, flight)
    assert closed_share(real, left, flight).min() > 0.8
    assert np.abs(centred(real, flight)[flight == 0].mean(axis=0)).max() < 1e-12


SIDE = (0.25, 0.45, 0.1)
"""A drag that is not the same along x and y, so that a heading changes what a wind does."""
SLOW = {"speed": 1.5, "noise": 3.0, "linear_drag": (SIDE,)}


def names(logs, vehicle=VEHICLE):
    """Return what the force view names, with what could stand in its place."""
    found = diagnose(logs, vehicle, by="views")
    force = next(one for one in found.findings if one.source.name == "force")
    return {name.candidate.name: set(name.rivals) for name in force.names}, found


WIND = {**SLOW, "constant_wind": ((1.5, -2.0, 0.0),)}


@pytest.mark.slow
def test_a_wind_at_one_heading_is_one_of_a_set_and_with_two_or_a_known_drag_alone():
    logs = flights(4, headings=(0.3,), **WIND)
    one, _ = names(logs)
    assert set(one) == {"constant_wind", "linear_drag"}
    assert {"frame_tilt", "thrust_tilt"} <= one["constant_wind"]
    two, found = names(flights(4, headings=(0.3, 1.9, 1.9, 0.3), **WIND))
    assert set(two) == {"constant_wind", "linear_drag"} and two["constant_wind"] == set()
    velocity = found.vehicle.effects["constant_wind"].velocity
    assert velocity[:2] == pytest.approx([1.5, -2.0], abs=0.2)
    known, _ = names(logs, with_effects(VEHICLE, linear_drag=(SIDE,)))
    assert set(known) == {"constant_wind"} and not any("+" in n for n in known["constant_wind"])


@pytest.mark.slow
def test_flights_that_hardly_move_leave_wind_and_drag_and_a_leaning_frame():
    faint = {**SLOW, "speed": 0.2, "noise": 2.0, "constant_wind": ((0.4, -0.5, 0.0),)}
    found, _ = names(flights(4, headings=(0.3,), **faint))
    (effect,) = found
    whole = {effect, *found[effect]}
    assert whole >= {"frame_tilt", "thrust_tilt", "constant_wind + linear_drag"}


def test_noise_of_the_rotor_speeds_is_no_inertia_and_no_thrust():
    """Noise in what drives makes every slope smaller, as more inertia would."""
    found = diagnose(flights(4, 204, 5.0, 1.5), VEHICLE, by="views")
    assert (found.label, found.named) == ("no_gap", [])
