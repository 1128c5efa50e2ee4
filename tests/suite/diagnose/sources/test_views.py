"""Diagnoses by views, end to end: names, sizes, gaps, and mistakes that have been made before."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suite.diagnose.data.view import FORCE, SmoothedFlight, weak_form
from suite.diagnose.diagnose import diagnose
from suite.diagnose.estimate.parameters import candidates
from suite.diagnose.evidence.evidence import Evaluation
from suite.diagnose.evidence.view_means import centred
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.report.summary import next_steps
from suite.diagnose.search.evaluation import NamedEffect
from suite.diagnose.sources.examine import contradicted
from suite.diagnose.sources.source import DiagnosisInput
from suite.diagnose.sources.view_source import closed_share, fit_black_box, inputs_of
from suite.diagnose.sources.views import by_views as sources_of
from suite.diagnose.thresholds import THRESHOLDS
from suite.diagnose.verdict.disturbances import Swing, residual_swing
from tests.support.diagnosis_flights import fly_all
from tests.support.real_flights import VEHICLE, flights
from tests.support.vehicles import with_effects


def found_in(logs, vehicle=VEHICLE, view=None):
    """Return what is named, with what could stand in its place, and the diagnosis."""
    found = diagnose(logs, vehicle, by="views")
    names = {
        name.candidate.name: set(name.rivals)
        for finding, name in found.named
        if view in (None, finding.source.name)
    }
    return names, found


def test_a_drag_is_named_and_closes_what_any_model_could(by_views):
    assert by_views.verdict.label == "named" and by_views.warnings == []
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
    here = Evaluation(evidence, at, evidence.linearise(at, one.indices))
    torque = replace(force, named=(NamedEffect(one, 0.001, 1.0),), last=here, judged=here)
    assert [name for name, _ in contradicted(force, torque)] == [one] * count


@pytest.mark.slow
def test_a_drag_of_the_file_makes_way_for_what_rotors_do_and_none_stands_for_another():
    hidden = {"rotor_drag": 7.8e-5, "translational_lift": 0.027, "inflow": 1.5e-4}
    logs = flights(4, speed=4.0, hidden={name: (value,) for name, value in hidden.items()})
    given = with_effects(VEHICLE, linear_drag=((0.18, 0.18, 0.72),))
    rivals, found = found_in(logs, given, "force")
    assert rivals == {name: set() for name in ("linear_drag", *hidden)}
    effects = found.vehicle.effects
    assert effects["linear_drag"].coefficient == pytest.approx((0, 0, 0), abs=0.1)
    for name, value in hidden.items():
        assert effects[name].coefficient == pytest.approx(value, rel=0.1)


@pytest.mark.extended
def test_an_inertia_is_named_though_the_trim_of_each_flight_is_larger():
    logs = flights(4, seed=9, speed=4.0, inertia_scale=((0.8, 0.8, 0.8),))
    names, found = found_in(logs)
    before, after = found.main.before, found.main.after
    assert set(names) == {"inertia_scale"}
    assert found.vehicle.effects["inertia_scale"].scale == pytest.approx((0.8, 0.8, 0.8), abs=0.02)
    # With the flights' trims, and without them.
    assert after.total > before.total and after.rms < before.rms
    assert after.energy.sum() < before.energy.sum()


@pytest.mark.extended
def test_flights_of_two_vehicles_give_no_name_whose_interval_has_the_files_value():
    other = flights(2, 3, 5.0, hidden={"thrust_scale": (0.9,)})
    names, found = found_in([*flights(2, 1, 5.0), *other])
    assert not names and any("Are they of one vehicle?" in text for text in found.warnings)


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "duration_s", "fall"), [(0.004, 20.0, 0.0), (0.006, 12.0, 0.08)])
def test_a_battery_that_sags_is_named_with_its_size(rate, duration_s, fall):
    """By its voltage where that falls [V/s]; a slow effect is no noise with a memory."""
    logs = flights(4, seed=6, duration_s=duration_s, battery_sag=(rate, 0.0))
    if fall:
        logs = [replace(log, voltage=16.8 - fall * (log.time_s - log.time_s[0])) for log in logs]
    names, found = found_in(logs)
    assert set(names) == {"battery_sag"} and (fall == 0.0 or found.verdict.label == "named")
    sag = found.vehicle.effects["battery_sag"]
    if fall:
        assert sag.per_volt == pytest.approx(rate / fall, rel=0.1)
    else:
        assert sag.rate == pytest.approx(rate, rel=0.05)


@pytest.mark.extended
def test_an_attitude_alone_shows_the_torque_as_finely_as_a_gyro():
    moved = flights(4, 5, 5.0, com_offset=((0.006, -0.002, 0.0),))
    lost, about = np.full_like(moved[0].rate_b, np.nan), {"partial": ["rate"]}
    without_gyro = [replace(log, rate_b=lost, about=about) for log in moved]
    assert set(found_in(without_gyro)[0]) == {"com_offset"}


def test_a_black_box_explains_what_depends_on_the_motion_and_no_noise(by_views):
    last = by_views.findings[0].search.last
    inputs = np.concatenate([inputs_of(flight) for flight in last.evidence.flights])
    flight = last.block.data.flight
    noise = np.random.default_rng(0).standard_normal((len(flight), 3))
    said = inputs @ fit_black_box(inputs, noise, flight)
    assert closed_share(noise, noise - said, flight).max() < 0.2
    real = 2.0 * inputs[:, [0, 1, 2]] + 0.1 * noise
    left = real - inputs @ fit_black_box(inputs, real, flight)
    assert closed_share(real, left, flight).min() > 0.8
    assert np.abs(centred(real, flight)[flight == 0].mean(axis=0)).max() < 1e-12


@pytest.mark.extended
def test_a_reference_flight_that_never_flies_is_not_listed_as_one():
    new, old = flights(2, 8, 2.0), flights(2, 9, 2.0)
    still = {key: 0.0 * getattr(old[0], key) for key in ("vel_w", "thrust_cmd", "rotor_speed")}
    given = DiagnosisInput(
        new, VEHICLE, [*old, replace(old[0], **still)], "auto", "auto", print, THRESHOLDS, True
    )
    made = sources_of(given)
    assert made.references == tuple(log.name for log in old)
    assert any(text.startswith(f"{old[0].name}: no stretch") for text in made.warnings)


SIDE = (0.25, 0.45, 0.1)
"""A drag that is not the same along x and y, so that a heading changes what a wind does."""
SLOW = {"speed": 1.5, "noise": 3.0, "linear_drag": (SIDE,)}
WIND = {**SLOW, "constant_wind": ((1.5, -2.0, 0.0),)}


@pytest.mark.slow
def test_a_wind_at_one_heading_is_one_of_a_set_and_with_two_or_a_known_drag_alone():
    logs = flights(4, headings=(0.3,), **WIND)
    one, _ = found_in(logs, view="force")
    assert set(one) == {"constant_wind", "linear_drag"}
    assert {"frame_tilt", "thrust_tilt"} <= one["constant_wind"]
    two, found = found_in(flights(4, headings=(0.3, 1.9, 1.9, 0.3), **WIND), view="force")
    assert set(two) == {"constant_wind", "linear_drag"} and two["constant_wind"] == set()
    velocity = found.vehicle.effects["constant_wind"].velocity
    assert velocity[:2] == pytest.approx([1.5, -2.0], abs=0.2)
    known, _ = found_in(logs, with_effects(VEHICLE, linear_drag=(SIDE,)), "force")
    assert set(known) == {"constant_wind"} and not any("+" in n for n in known["constant_wind"])


@pytest.mark.slow
def test_flights_that_hardly_move_leave_wind_and_drag_and_a_leaning_frame():
    faint = {**SLOW, "speed": 0.2, "noise": 2.0, "constant_wind": ((0.4, -0.5, 0.0),)}
    names, _ = found_in(flights(4, headings=(0.3,), **faint), view="force")
    ((effect, rivals),) = names.items()
    assert {effect, *rivals} >= {"frame_tilt", "thrust_tilt", "constant_wind + linear_drag"}


def test_noise_of_the_rotor_speeds_is_no_inertia_and_no_thrust():
    """Noise in what drives makes every slope smaller, as more inertia would."""
    names, found = found_in(flights(4, 204, 4.0, 1.5))
    assert (found.verdict.label, names) == ("no_gap", {})


def pushed(extra, seed, duration_s=6.0):
    """Return flights with an acceleration that no effect of the catalogue makes."""
    seeds, extras = range(seed, seed + 4), [extra] * 4
    return fly_all([VEHICLE] * 4, seeds, duration_s, 3.0, motors=True, extras=extras)


def drag_to_one_side(motion, t):
    ahead = motion.rot_w[:, 0]
    return -0.5 * max(float(motion.vel_w @ ahead), 0.0) * ahead


def hysteresis(motion, t):
    return (2.0 if motion.vel_w[2] > 0.0 else -1.0) * motion.rot_w[:, 2]


@pytest.mark.extended
@pytest.mark.parametrize(
    ("extra", "seed", "duration_s"),
    [(drag_to_one_side, 20, 4.0), (hysteresis, 40, 12.0)],
)
def test_what_is_outside_the_catalogue_is_no_wind_and_no_thrust_alone(extra, seed, duration_s):
    names, found = found_in(pushed(extra, seed, duration_s))
    assert found.verdict.label in ("partly", "unknown") and "constant_wind" not in names
    assert found.verdict.where is not None


def test_a_force_that_nothing_explains_is_not_no_gap():
    """Three flights of 6 s are too few to fit a regression to it, and the search finds nothing."""

    def by_place(motion, t):
        return 1.5 * np.array([np.sin(1.5 * motion.pos_w[0]), np.cos(1.5 * motion.pos_w[1]), 0.0])

    names, found = found_in(pushed(by_place, 20))
    assert (found.verdict.label, names) == ("unknown", {})
    assert found.verdict.share_left > 0.9 and "m/s^2 beyond the noise" in found.verdict.where
    shown = found.main.source.series(found.main.search)
    assert shown.label.partition("body ")[2][0] in "xy", "the picture shows where the error is"


@pytest.mark.slow
def test_one_effect_is_named_without_a_second_small_one_but_with_what_looks_alike():
    names, found = found_in(flights(4, seed=11, speed=4.0, blade_flapping=(2e-6,)))
    ((name, rivals),) = names.items()
    assert found.verdict.label == "named" and "blade_flapping" in {name, *rivals}
    names, _ = found_in(flights(4, seed=12, speed=1.0, mass_offset=(0.08,)))
    assert {"mass_offset", "thrust_scale"} <= {*names, *set().union(*names.values())}


TIME_S = np.arange(0.0, 20.0, 0.01)


def made(period_s, pull, moved, rng, noise=0.1):
    """Return a level flight that moves by `moved`, and its residual: a `pull` at a period."""
    form = weak_form(TIME_S, np.ones(len(TIME_S), bool), 0.2, 0.1)
    turn = 2.0 * np.pi * form.middle_s[:, None] / period_s + rng.uniform(0.0, 6.0, 3)
    left = pull * np.sin(turn) + noise * rng.standard_normal(turn.shape)
    measured = moved * np.sin(turn + 1.0) + left
    motion = SimpleNamespace(rot_w=np.broadcast_to(np.eye(3), (len(TIME_S), 3, 3)))
    rows: Any = SimpleNamespace(motion=motion)
    return SmoothedFlight(rows, form, measured), left


def swing_of(*made):
    flights, left = zip(*made, strict=True)
    flight = np.repeat(np.arange(len(left)), [len(one) for one in left])
    data = SimpleNamespace(residual=np.concatenate(left), flight=flight)
    task: Any = SimpleNamespace(
        view=FORCE, flights=flights, residuals=lambda _: data, limits=THRESHOLDS
    )
    return residual_swing(task, np.zeros(0))


def test_a_pull_at_one_period_is_a_swing_and_own_motion_noise_or_other_periods_are_none():
    rng = np.random.default_rng(0)
    found = swing_of(*(made(1.4, 0.3, 0.1, rng) for _ in range(3)))
    assert found is not None and found.ci95[0] < 1.4 < found.ci95[1]
    assert found.ci95[1] - found.ci95[0] < 0.2
    assert found.length_m == pytest.approx(9.81 * found.period_s**2 / 39.48, rel=1e-3)
    assert "1.4" in found.words and "0.49 m" in Swing(1.4, (1.3, 1.5)).words
    for seed in range(4):
        rng = np.random.default_rng(seed)
        assert swing_of(*(made(1.4, 0.0, 0.0, rng) for _ in range(3))) is None
    assert swing_of(*(made(1.4, 0.3, 3.0, rng) for _ in range(3))) is None
    assert swing_of(*(made(period_s, 0.1, 0.0, rng) for period_s in (0.7, 1.0, 1.5, 2.2))) is None
    flight, left = made(1.4, 0.3, 0.1, rng)
    form = flight.form._replace(middle_s=flight.form.middle_s[:7])
    assert swing_of((flight._replace(form=form), left[:7])) is None, "too short for a spectrum"


@pytest.mark.slow
def test_a_load_on_a_line_is_said_to_swing_with_its_period():
    logs = flights(4, seed=1, duration_s=10.0, speed=1.0, load=(0.08, 0.5))
    _, found = found_in(logs)
    swing = found.findings[0].remaining.swing
    assert found.verdict.label in ("partly", "unknown") and swing is not None
    # A pendulum on a free body of 0.75 kg swings faster than on a wall, by sqrt(1 + 0.08 / 0.75).
    assert swing.period_s == pytest.approx(1.42 / np.sqrt(1.0 + 0.08 / 0.75), rel=0.08)
    entries = diagnosis_json(found)
    steps = " ".join(next_steps(entries))
    assert f"length = {swing.length_m:.2g} into [effects.slung_load]" in steps
    assert "oscillates with a period of 1." in entries["unexplained"]["where"]
