"""A case is built the same to the bit, and what is hidden acts as strongly as it says."""

import numpy as np
import pytest

from eval.effects import EFFECTS, nameable_effects
from eval.flights.simulate import fly
from eval.flights.trajectory import Trajectory
from eval.logs.flight_log import read_flight
from suite.blind import build as module
from suite.blind.build import build
from suite.blind.cases import Case
from suite.blind.make import open_answers
from suite.blind.oracle.strength import columns_in_table, detectable_along, nominal_vehicle
from suite.blind.outside import KINDS as OUTSIDE
from suite.blind.outside import changed_values, draw_change
from tests.support.blind import SINGLE
from tracks.common.files import plain

pytestmark = pytest.mark.usefixtures("short_flights")


def test_a_case_is_the_same_to_the_bit_and_its_seed_matters(made_set, monkeypatch):
    monkeypatch.setattr(module, "_expected_names", lambda *_: {})  # how strong it is takes longest
    first, again = build(SINGLE), made_set / "cases" / "case_001" / "flight_1.parquet"
    np.testing.assert_array_equal(first.logs[0].pos_w, read_flight(again).pos_w)
    assert (first.logs[0].integrator, first.logs[0].step_s) == ("euler", 0.002)
    stored = open_answers(made_set)["case_001"]
    (effect,), (kept,) = plain(first.answer)["effects"], stored.pop("effects")
    assert {"kind", "verdict"} <= set(stored) and stored["verdict"] == "named"
    assert all(kept[key] == effect[key] for key in ("name", "parameters", "multiple"))
    assert kept["sigma"] > 0.0
    other = build(Case("single", ("linear_drag",), 6.0, "bare", "estimator", (6, 1)))
    assert other.answer["effects"][0]["parameters"] != first.answer["effects"][0]["parameters"]
    # What is hidden is in the flights, and not in the vehicle file.
    assert "linear_drag" not in first.nominal.effects
    coefficient = np.array(first.answer["effects"][0]["parameters"]["coefficient"])
    flight = fly(first.nominal, first.truth, first.trajectories)[0]
    vel_b = np.einsum("tij,ti->tj", flight.motion.rot_w, flight.motion.vel_w)
    # The accelerometer of a vehicle without other aerodynamics shows the drag alone across.
    across = flight.acc_b[1:, :2]
    np.testing.assert_allclose(across, -coefficient[:2] * vel_b[:-1, :2], rtol=1e-6, atol=1e-9)


def test_outside_cases_say_how_much_the_catalogue_cannot_explain():
    built = build(Case("outside", ("ripple",), 6.0, "bare", "capture", (5, 3)))
    outside = built.answer["outside"]
    assert built.answer["verdict"] == "unknown" and not built.truth.effects
    assert outside["multiple"] == pytest.approx(6.0, rel=0.25) or outside["strength"] == 0.3


BARE = nominal_vehicle("bare")


def test_physics_outside_the_catalogue_moves_the_vehicle_and_a_load_weighs_what_it_weighs():
    way = Trajectory("climb", duration_s=2.0, speed=3.0, size=1.0)
    plain = fly(BARE, BARE, [way])[0]
    for name, kind in OUTSIDE.items():
        moved = fly(BARE, BARE, [way], extra=kind.make(kind.usual, BARE.mass))[0]
        acts = np.abs(moved.extra.force_b).max()
        acts += np.abs(moved.acting.thrust - moved.command.thrust).max()
        assert acts > 0.0 and np.abs(moved.motion.pos_w - plain.motion.pos_w).max() > 1e-5, name
    load = OUTSIDE["slung_load"].make(0.03, BARE.mass)
    flight = fly(BARE, BARE, [Trajectory("hover", 0.2)], extra=load)[0]
    assert flight.extra.force_b[0, 2] == pytest.approx(-0.03 * 9.81, rel=1e-6)


def test_a_strength_is_the_multiple_of_the_table_or_cut_at_a_bound():
    for name in nameable_effects():
        vehicle = BARE if name not in ("constant_wind", "gusts") else nominal_vehicle("dragged")
        rng = np.random.default_rng(3)
        change, multiple = draw_change(rng, vehicle, "full", name, 2.0)
        values = changed_values(vehicle, "full", name, change, rng)
        assert multiple <= 2.0 and np.abs(change).max() > 0.0, name
        direction = change / np.linalg.norm(change)
        unit = detectable_along(vehicle.name, "full", name, direction)
        assert np.linalg.norm(change) / unit == pytest.approx(multiple, rel=1e-6), name
        assert len(columns_in_table(vehicle.name, "full", name)) == len(change)
        assert isinstance(values, EFFECTS[name].values)
