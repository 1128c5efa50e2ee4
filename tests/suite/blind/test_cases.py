"""The cases of a set: their numbers, how they are built, and how strong what is hidden is."""

import json
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from eval.effects import EFFECTS, nameable_effects
from eval.flights.simulate import SENSORS, fly, log_of
from eval.flights.trajectory import Trajectory
from eval.logs.flight_log import read_flight
from eval.vehicles.vehicle import with_effects
from suite.blind import build as module
from suite.blind import make, oracle
from suite.blind.build import build
from suite.blind.cases import DRAWERS, MULTIPLES, SETS, Case, draw_cases, draw_continuous_cases
from suite.blind.continuous.timing import draw_conditions
from suite.blind.outside import KINDS as OUTSIDE
from suite.blind.outside import changed_values, draw_change
from tests.support.blind import SINGLE
from tests.support.faults import IMU_FAULT, with_imu_fault
from tests.support.ways import BARE, bare_flights
from tracks.common.files import plain


def test_a_full_set_has_the_numbers_that_were_promised():
    cases = draw_cases(SETS["published"])
    kinds = Counter(case.kind for case in cases.values())
    others = {"null": 100, "outside": 40, "pair": 20, "blurred": 15, "separated": 15}
    assert kinds == {"single": 2 * len(nameable_effects()), **others}
    singles = {(c.hidden[0], c.multiple) for c in cases.values() if c.kind == "single"}
    assert singles == {(name, m) for name in nameable_effects() for m in (2.0, 6.0)}
    outside = {case.hidden[0] for case in cases.values() if case.kind == "outside"}
    assert len(outside) >= 6
    blurred = sorted((c.seed, c.hidden) for c in cases.values() if c.kind == "blurred")
    apart = sorted((c.seed, c.hidden) for c in cases.values() if c.kind == "separated")
    assert blurred == apart, "the same pairs with the same truth"


def test_the_continuous_set_has_its_numbers_and_each_single_effect_once():
    cases = draw_continuous_cases(SETS["published"])
    kinds = Counter(case.kind for case in cases.values())
    assert kinds == {"null": 24, "single": 22, "pair": 10, "outside": 4}
    singles = [case for case in cases.values() if case.kind == "single"]
    assert len({case.hidden for case in singles}) == 22
    assert Counter(case.multiple for case in singles) == {m: 11 for m in MULTIPLES}
    assert {case.simulator for case in cases.values()} == {"continuous"}
    assert not any("hysteresis" in case.hidden for case in cases.values())


def test_the_continuous_set_hides_no_effect_that_its_engine_lacks(monkeypatch):
    cases = draw_continuous_cases(3)
    with_imu_fault(monkeypatch)
    assert IMU_FAULT.name in nameable_effects() and draw_continuous_cases(3) == cases


@pytest.mark.parametrize("simulator", DRAWERS)
def test_a_few_cases_are_of_every_kind_and_none_of_an_effect_that_no_flight_can_tell(
    simulator, monkeypatch
):
    draw = DRAWERS[simulator]
    whole = Counter(case.kind for case in draw(1, None).values())
    for count in (1, 12):
        few = Counter(case.kind for case in draw(1, count).values())
        share = count / whole.total()
        assert few == {kind: max(round(share * n), 1) for kind, n in whole.items()}
    assert draw(1, whole.total()) == draw(1, 10**5) == draw(1, None)
    with pytest.raises(ValueError, match="count = 0: must be at least 1"):
        draw(1, 0)
    # Sets that are published stay what they are, whatever such effects the catalogue gains.
    cases = draw(SETS["published"], None)
    unnameable = set(EFFECTS) - set(nameable_effects())
    assert unnameable == {"slung_load", "hub_drag"}
    hidden = {name for c in cases.values() if c.kind != "outside" for name in c.hidden}
    assert hidden and not hidden & unnameable
    for name in unnameable:
        monkeypatch.delitem(EFFECTS._entries, name)
    assert not unnameable & set(EFFECTS) and draw(SETS["published"], None) == cases


def test_no_two_simulators_and_no_two_sets_share_a_seed():
    sets = [draw(seed, None).values() for draw in DRAWERS.values() for seed in SETS.values()]
    seeds = [case.seed for cases in sets for case in cases if case.kind != "separated"]
    assert len(seeds) == len(set(seeds))


NAMES = ("rotor_drag", "linear_drag", "com_offset", "gyro_bias", "weak_motor")


@pytest.fixture(scope="module")
def flights():
    return [log_of(flight, BARE, SENSORS["capture"], None) for flight in bare_flights()]


@pytest.fixture(scope="module")
def info(flights):
    return oracle.information(BARE, flights, SENSORS["capture"])


@pytest.mark.extended
def test_information_grows_with_flights_and_knows_hand_worked_parts(flights, info):
    one = oracle.information(BARE, flights[:1], SENSORS["capture"], NAMES)
    of_both = [info.columns.index(column) for column in one.columns]
    assert (np.diag(info.matrix)[of_both] >= np.diag(one.matrix) - 1e-9).all()
    # A gyro bias moves one channel by itself; each row says 1 / sigma^2, less what the unknown
    # start takes (its rate and its drift in attitude).
    index = one.columns.index(oracle.Column("gyro_bias", "bias", 2))
    stretches = int(flights[0].time_s[-1] - 0.3)
    most = 101 * stretches / SENSORS["capture"].gyro ** 2
    assert 0.1 * most < one.matrix[index, index] < most


def test_lookalikes_look_alike_and_strangers_do_not(info):
    size = 6.0 * oracle.detectable(info.block("rotor_drag"), np.ones(1))
    change = {"rotor_drag": size * np.ones(1)}
    given = (info, change, "rotor_drag")
    near, far = (oracle.remaining_ratio(*given, k, BARE) for k in ("linear_drag", "com_offset"))
    whole = 36.0 * 12.5
    assert near < 0.05 * whole and 0.5 * whole < far <= whole * (1 + 1e-6)
    (found,) = oracle.alternatives(info, change, BARE).values()
    assert "com_offset" not in found and "accelerometer_bias" not in found


def test_every_effect_has_columns_but_what_cannot_be_told():
    columns = oracle.columns_of(False)
    assert {column.effect for column in columns} == set(nameable_effects()) - {"gusts"}
    assert oracle.Column("com_offset", "offset", 2) not in columns
    sag = [c.parameter for c in oracle.columns_of(True) if c.effect == "battery_sag"]
    assert sag == ["per_volt"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("vehicle", "sensors", "names"),
    [
        ("dragged", "full", ["rotor_drag", "clock_offset", "weak_motor", "gusts"]),
        ("bare", "capture", ["constant_wind", "gusts"]),
    ],
)
def test_the_committed_table_is_what_is_worked_out(vehicle, sensors, names):
    stored = json.loads(oracle.TABLE.read_text())["vehicles"][vehicle][sensors]
    assert list(stored) and set(stored) == set(nameable_effects())
    for name, entry in oracle.strengths(vehicle, sensors, names).items():
        assert entry["columns"] == stored[name]["columns"]
        if "matrix" in entry:
            np.testing.assert_allclose(entry["matrix"], stored[name]["matrix"], rtol=1e-6)
        else:
            kept = np.inf if stored[name]["detectable"] is None else stored[name]["detectable"]
            assert entry["detectable"] == pytest.approx(kept, rel=1e-6)


@pytest.mark.parametrize(("size", "strong"), [(0.0, False), (0.02, False), (1.0, True)])
def test_a_wind_beyond_its_bound_is_never_detectable(monkeypatch, size, strong):
    """What rotors in forward flight pass on of a wind would show a gust of 30 m/s."""
    rows = np.random.default_rng(0).standard_normal((40 * oracle.GUST_DRAWS, 30))
    monkeypatch.setattr(oracle, "fly", lambda *_, **__: [])
    monkeypatch.setattr(oracle, "linearised", lambda *_: SimpleNamespace(residual=size * rows))
    found = oracle.gust_strength(BARE, (), SENSORS["capture"], "gusts", np.random.default_rng(0))
    assert np.isfinite(found) == strong and (not strong or found < 8.0)


def test_an_effect_that_is_not_in_the_table_is_worked_out(monkeypatch):
    monkeypatch.setattr(oracle, "_entry", oracle._entry.__wrapped__)
    entry = {"columns": [["turn", 0], ["late", 0]], "matrix": [[25.0, 0.0], [0.0, 100.0]]}
    monkeypatch.setattr(oracle, "strengths", lambda vehicle, sensors, names: {names[0]: entry})
    along = [oracle.detectable_along("bare", "full", "imu_fault", axis) for axis in np.eye(2)]
    assert along == pytest.approx([1.0, 0.5])
    (_, late) = oracle.columns_in_table("bare", "full", "imu_fault")
    assert late == oracle.Column("imu_fault", "late", 0)


@pytest.mark.extended
def test_a_case_is_the_same_to_the_bit_and_its_seed_matters(made_set, monkeypatch, short_flights):
    monkeypatch.setattr(module, "_expected_names", lambda *_: {})  # how strong it is takes longest
    first, again = build(SINGLE), made_set / "cases" / "case_001" / "flight_1.parquet"
    np.testing.assert_array_equal(first.logs[0].pos_w, read_flight(again).pos_w)
    assert (first.logs[0].integrator, first.logs[0].step_s) == ("euler", 0.002)
    stored = make.open_answers(made_set)["case_001"]
    (effect,), (kept,) = plain(first.answer)["effects"], stored.pop("effects")
    assert {"kind", "verdict"} <= set(stored) and stored["verdict"] == "named"
    assert all(kept[key] == effect[key] for key in ("name", "parameters", "multiple"))
    assert kept["sigma"] > 0.0
    other = build(replace(SINGLE, seed=(6, 1)))
    assert other.answer["effects"][0]["parameters"] != first.answer["effects"][0]["parameters"]
    # What is hidden is in the flights, and not in the vehicle file.
    assert "linear_drag" not in first.nominal.effects
    coefficient = np.array(first.answer["effects"][0]["parameters"]["coefficient"])
    hidden = {"linear_drag": EFFECTS["linear_drag"].values(tuple(coefficient))}
    ways = [Trajectory(**way) for way in first.answer["trajectories"]]
    (flight,) = fly(first.nominal, with_effects(first.nominal, hidden), ways)
    vel_b = np.einsum("tij,ti->tj", flight.motion.rot_w, flight.motion.vel_w)
    # The accelerometer of a vehicle without other aerodynamics shows the drag alone across.
    across = flight.acc_b[1:, :2]
    np.testing.assert_allclose(across, -coefficient[:2] * vel_b[:-1, :2], rtol=1e-6, atol=1e-9)


@pytest.mark.extended
def test_outside_cases_say_how_much_the_catalogue_cannot_explain(short_flights):
    built = build(Case("outside", ("ripple",), 6.0, "bare", "capture", (5, 3)))
    outside = built.answer["outside"]
    assert built.answer["verdict"] == "unknown" and not built.answer["effects"]
    assert outside["multiple"] == pytest.approx(6.0, rel=0.25) or outside["strength"] == 0.3


def test_physics_outside_the_catalogue_moves_the_vehicle_and_a_load_weighs_what_it_weighs():
    def position(duration_s, extra=None):
        way = Trajectory("climb", duration_s, speed=3.0, size=1.0)
        return fly(BARE, BARE, [way], extra=extra)[0].motion.pos_w

    short, long = 0.25, 2.0  # it meets its own wake when it comes down
    bare = {duration_s: position(duration_s) for duration_s in (short, long)}
    for name, kind in OUTSIDE.items():
        duration_s = long if name == "wake" else short
        moved = position(duration_s, kind.make(kind.usual, BARE.mass))
        assert np.abs(moved - bare[duration_s]).max() > 1e-5, name
    load = OUTSIDE["slung_load"].make(0.03, BARE.mass)
    flight = fly(BARE, BARE, [Trajectory("hover", 0.2)], extra=load)[0]
    lacking = BARE.mass * (9.81 - flight.acc_b[1, 2])
    assert lacking == pytest.approx(0.03 * 9.81, rel=1e-6)


def test_a_strength_is_the_multiple_of_the_table_or_cut_at_a_bound():
    for name in nameable_effects():
        in_wind = name in ("constant_wind", "gusts")
        vehicle = oracle.nominal_vehicle("dragged" if in_wind else "bare")
        rng = np.random.default_rng(3)
        change, multiple = draw_change(rng, vehicle, "full", name, 2.0)
        values = changed_values(vehicle, "full", name, change, rng)
        assert multiple <= 2.0 and np.abs(change).max() > 0.0, name
        direction = change / np.linalg.norm(change)
        unit = oracle.detectable_along(vehicle.name, "full", name, direction)
        assert np.linalg.norm(change) / unit == pytest.approx(multiple, rel=1e-6), name
        assert len(oracle.columns_in_table(vehicle.name, "full", name)) == len(change)
        assert isinstance(values, EFFECTS[name].values)


CONTINUOUS = replace(SINGLE, seed=(6, 70_001), simulator="continuous")


@pytest.mark.extended
def test_a_continuous_cases_vehicle_has_the_loop_that_its_seed_draws(monkeypatch, short_flights):
    """That a flight is the same to the bit again is asked in test_flights.py."""
    judged = []
    monkeypatch.setattr(module, "_expected_names", lambda *given: judged.append(given) or {})
    first = build(CONTINUOUS)
    conditions = first.answer["conditions"]
    assert first.nominal.controller.frequency == conditions["loop_hz"]
    assert first.nominal.name == "bare" and not first.nominal.effects
    assert first.logs[0].integrator is None
    about = dict(first.logs[0].about)
    assert about == {"source": "suite blind", "vehicle": "bare"}, "nothing of the conditions"
    spacing = np.median(np.diff(first.logs[0].time_s))
    assert spacing == pytest.approx(1.0 / conditions["row_hz"], rel=0.1)
    # Its strength is worked out on the flight as it was, without noise.
    ((_, nominal, (exact,), _, named),) = judged
    assert nominal == first.nominal and list(named) == ["linear_drag"]
    jumps = [np.diff(log.vel_w, 2, axis=0).std() for log in (exact, first.logs[0])]
    assert jumps[0] < 0.1 * jumps[1]
    simulator = module.Simulator(CONTINUOUS, np.random.default_rng(3))
    drawn = draw_conditions(np.random.default_rng(3))
    assert simulator.conditions == drawn
    assert simulator.nominal.controller.frequency == drawn.loop_hz
    assert not module.Simulator(SINGLE, np.random.default_rng()).conditions
