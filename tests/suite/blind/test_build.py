"""Cases are numbered, built the same to the bit, and hide something as strong as they say."""

from collections import Counter

import numpy as np
import pytest

from eval.effects import EFFECTS, nameable_effects
from eval.logs.flight_log import read_flight
from suite.blind import build as module
from suite.blind.build import build
from suite.blind.cases import (
    DRAWERS,
    MULTIPLES,
    SETS,
    Case,
    draw_cases,
    draw_continuous_cases,
)
from suite.blind.make import open_answers
from suite.blind.oracle.strength import columns_in_table, detectable_along, given_vehicle
from suite.blind.outside import KINDS as OUTSIDE
from suite.blind.outside import changed_values, draw_change, make_outside
from suite.diagnose.plans.simulate import fly
from suite.diagnose.plans.trajectory import Trajectory
from tests.support.blind import SINGLE
from tracks.common.files import plain

pytestmark = pytest.mark.usefixtures("short_flights")


def test_a_case_is_the_same_to_the_bit_and_its_seed_matters(made_set, monkeypatch):
    monkeypatch.setattr(module, "_judged", lambda *_: {})  # how strong it is takes longest
    first, again = build(SINGLE), made_set / "cases" / "case_001" / "flight_1.parquet"
    np.testing.assert_array_equal(first.logs[0].pos_w, read_flight(again).pos_w)
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


BARE = given_vehicle("bare")


def test_physics_outside_the_catalogue_moves_the_vehicle():
    way = Trajectory("climb", duration_s=2.0, speed=3.0, size=1.0)
    plain = fly(BARE, BARE, [way])[0]
    for name, kind in OUTSIDE.items():
        moved = fly(BARE, BARE, [way], extra=make_outside(name, kind.usual, BARE.mass))[0]
        acts = np.abs(moved.extra.force_b).max()
        acts += np.abs(moved.acting.thrust - moved.command.thrust).max()
        assert acts > 0.0 and np.abs(moved.motion.pos_w - plain.motion.pos_w).max() > 1e-5, name


def test_a_hanging_load_weighs_what_it_weighs():
    flight = fly(
        BARE, BARE, [Trajectory("hover", 1.0)], extra=make_outside("slung_load", 0.03, BARE.mass)
    )[0]
    assert flight.extra.force_b[0, 2] == pytest.approx(-0.03 * 9.81, rel=1e-6)


def test_a_strength_is_the_multiple_of_the_table_or_cut_at_a_bound():
    nominal = given_vehicle("bare")
    for name in nameable_effects():
        vehicle = nominal if name not in ("constant_wind", "gusts") else given_vehicle("dragged")
        rng = np.random.default_rng(3)
        change, multiple = draw_change(rng, vehicle, "full", name, 2.0)
        values = changed_values(vehicle, "full", name, change, rng)
        assert multiple <= 2.0 and np.abs(change).max() > 0.0, name
        direction = change / np.linalg.norm(change)
        unit = detectable_along(vehicle.name, "full", name, direction)
        assert np.linalg.norm(change) / unit == pytest.approx(multiple, rel=1e-6), name
        assert len(columns_in_table(vehicle.name, "full", name)) == len(change)
        assert isinstance(values, EFFECTS[name].values)


def test_a_full_set_has_the_numbers_that_were_promised():
    cases = draw_cases(SETS["published"])
    kinds = Counter(case.kind for case in cases.values())
    assert kinds == {
        "single": 2 * len(nameable_effects()),
        "null": 100,
        "outside": 40,
        "pair": 20,
        "blurred": 15,
        "separated": 15,
    }
    singles = {(c.hidden[0], c.multiple) for c in cases.values() if c.kind == "single"}
    assert singles == {(name, m) for name in nameable_effects() for m in (2.0, 6.0)}
    outside = {case.hidden[0] for case in cases.values() if case.kind == "outside"}
    assert len(outside) >= 6
    blurred = sorted((c.seed, c.hidden) for c in cases.values() if c.kind == "blurred")
    apart = sorted((c.seed, c.hidden) for c in cases.values() if c.kind == "separated")
    assert blurred == apart, "the same pairs with the same truth"


def test_sets_repeat_by_seed_and_do_not_share_cases():
    tuning, published = draw_cases(SETS["tuning"]), draw_cases(SETS["published"])
    assert tuning == draw_cases(SETS["tuning"])
    assert not {c.seed for c in tuning.values()} & {c.seed for c in published.values()}


def test_the_continuous_set_has_its_numbers_and_each_single_effect_once():
    cases = draw_continuous_cases(SETS["published"])
    kinds = Counter(case.kind for case in cases.values())
    assert kinds == {"null": 24, "single": 22, "pair": 10, "outside": 4}
    singles = [case for case in cases.values() if case.kind == "single"]
    assert len({case.hidden for case in singles}) == 22
    assert Counter(case.multiple for case in singles) == {m: 11 for m in MULTIPLES}
    assert {case.simulator for case in cases.values()} == {"continuous"}
    assert not any("hysteresis" in case.hidden for case in cases.values())


@pytest.mark.parametrize("simulator", DRAWERS)
def test_a_few_cases_are_of_every_kind(simulator):
    draw = DRAWERS[simulator]
    whole = Counter(case.kind for case in draw(1, None).values())
    for count in (1, 12):
        few = Counter(case.kind for case in draw(1, count).values())
        share = count / whole.total()
        assert few == {kind: max(round(share * n), 1) for kind, n in whole.items()}
    assert draw(1, whole.total()) == draw(1, 10**5) == draw(1, None)
    with pytest.raises(ValueError, match="count = 0: must be at least 1"):
        draw(1, 0)


@pytest.mark.parametrize("simulator", DRAWERS)
def test_an_effect_that_no_flight_can_tell_is_never_drawn(simulator, monkeypatch):
    """Sets that are published stay what they are, whatever such effects the catalogue gains."""
    draw = DRAWERS[simulator]
    cases = draw(SETS["published"], None)
    assert "slung_load" in EFFECTS and "slung_load" not in nameable_effects()
    assert not any("slung_load" in c.hidden for c in cases.values() if c.kind != "outside")
    monkeypatch.delitem(EFFECTS._entries, "slung_load")
    assert "slung_load" not in EFFECTS and draw(SETS["published"], None) == cases


def test_no_two_simulators_and_no_two_sets_share_a_seed():
    seeds = [
        case.seed
        for draw in DRAWERS.values()
        for seed in SETS.values()
        for case in draw(seed, None).values()
        if case.kind != "separated"
    ]
    assert len(seeds) == len(set(seeds))
