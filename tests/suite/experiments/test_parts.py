"""Goals, spread, conditions and the cache by numbers worked by hand."""

import numpy as np
import pytest

from eval.effects import EFFECTS
from eval.judging.sensors import SensorNoise
from eval.judging.statistics import Interval
from eval.judging.tables import Cell
from eval.quadrotor.vehicle_file import load_vehicle
from suite.experiments import cache
from suite.experiments.cache import code_digest, digest
from suite.experiments.conditions import effect_conditions, log_faults, sweep_conditions, sweeps
from suite.experiments.goals import goals, verdict
from suite.experiments.paper import sim_to_sim
from suite.experiments.seed_tables import spread
from suite.experiments.sim_tables import where_it_breaks
from tests.support.vehicles import with_effects

VEHICLE = load_vehicle("reference")


def cell(track, level, success, v_max=5.0, low=None):
    speed = Interval(v_max, v_max, v_max)
    rate = Interval(success, success if low is None else low, 1.0)
    return Cell("p", track, level, 100, rate, 8.0, speed, speed, speed, {})


def test_the_papers_table_is_as_printed():
    table = sim_to_sim()
    assert len(table.cells) == 3 * 3 * 4
    won = {(c.method, c.track, c.level): c.won for c in table.cells}
    fast = {(c.method, c.track, c.level): c.v_max for c in table.cells}
    assert [won["without_delta", "zigzag", level] for level in table.levels] == [10, 10, 8, 2]
    assert [won["with_delta", "ellipse", level] for level in table.levels] == [10, 10, 9, 7]
    assert [won["baseline", "zigzag", level] for level in table.levels] == [10, 10, 10, 6]
    assert (fast["with_delta", "circular", 0], fast["baseline", "ellipse", 9]) == (6.4, 5.2)
    assert sum(won.values()) == 320 and sum(fast.values()) == pytest.approx(209.6)


def test_goals_by_hand():
    cells = [
        cell("zigzag", 0, 0.96, 7.3, low=0.902),  # others 10/10: the interval reaches down to 90 %
        cell("circular", 3, 0.93, 5.0, low=0.863),
        cell("zigzag", 9, 0.62, 6.1, low=0.52),  # others 7/10 at best: the rate itself
        cell("zigzag", 5, 0.1),  # no one printed a level 5
    ]
    zero, three, nine = goals(cells)
    assert (zero.success_miss, zero.v_max_miss) == (0, 0)
    assert zero.floor_miss == pytest.approx(0.01) and not zero.met
    assert three.success_miss == pytest.approx(0.037) and three.floor_miss == pytest.approx(0.04)
    assert (three.v_max, three.v_max_miss) == (6.2, pytest.approx(1.2))
    assert nine.success == 0.7 and nine.success_miss == pytest.approx(0.08)
    assert nine.v_max_miss == 0 and nine.floor_miss == pytest.approx(0.08)
    text = verdict([zero, three, nine])
    assert text.startswith("0 of 3 cells meet the whole goal: 1 in success")
    assert "zigzag at level 9, by 8 points; v_max misses most on circular at level 3" in text
    (perfect,) = goals([cell("ellipse", 6, 1.0, 6.4, low=0.963)])
    assert perfect.met and verdict([perfect]).startswith("1 of 1 cells meet the whole goal")


def test_where_it_breaks_is_the_first_gap():
    rates = [1.0, 0.95, 0.85, 0.95, 0.6, 0.4, 0.55]
    cells = [cell(track, level, rate) for track in ("zigzag", "circular", "ellipse")
             for level, rate in enumerate(rates)]  # fmt: skip
    assert "zigzag 1 (half: 4), circular 1" in where_it_breaks("p", cells)


def test_the_median_policy_and_the_spread():
    rates = {"a": (0.9, 0.7), "b": (1.0, 1.0), "c": (0.2, 0.4), "d": (0.9, 0.8)}
    cells = {n: [cell("zigzag", k, r) for k, r in enumerate(of)] for n, of in rates.items()}
    found = spread({name: cells[name] for name in "abc"})
    assert found.median == "a" and found.mean_success["c"] == pytest.approx(0.3)
    assert found.mean == pytest.approx(0.7)
    assert found.standard_deviation == pytest.approx(np.std([0.8, 1.0, 0.3], ddof=1))
    assert spread(cells).median == "a", "of an even number the lower of the middle two"
    assert np.isnan(spread({"a": cells["a"]}).standard_deviation)


def test_every_effect_that_touches_a_flight_is_flown_at_its_usual_size():
    conditions = effect_conditions(VEHICLE)
    flown = {condition.name for condition in conditions}
    assert flown | set(log_faults()) == set(EFFECTS) and len(log_faults()) == 3
    for condition in conditions:
        assert condition.vehicle.effects[condition.name] is not None
        others = {k: v for k, v in condition.vehicle.effects.items() if k != condition.name}
        own = {k: v for k, v in VEHICLE.effects.items() if k != condition.name}
        assert others == own and condition.noise == SensorNoise()
    by_words = {(c.name, c.words): c.vehicle.effects[c.name] for c in conditions}
    # The vehicle has drag of its own; what is more of the two stays, axis by axis.
    assert by_words["linear_drag", "coefficient (0.5, 0.5, 0.72) 1/s"].coefficient[2] == 0.72
    assert by_words["motor_lag", "time_constant 0.06 s"].time_constant == 0.06
    assert by_words["command_delay", "delay 0.04 s"].delay == 0.04
    assert by_words["thrust_scale", "scale 0.85"].scale == pytest.approx(0.85)
    assert by_words["thrust_scale", "scale 1.15"].scale == pytest.approx(1.15)
    assert by_words["weak_motor", "scale (0.85, 1, 1, 1)"].scale[0] == pytest.approx(0.85)
    assert np.linalg.norm(by_words["constant_wind", "velocity (-3, 4, 0) m/s"].velocity) == 5
    assert np.linalg.norm(
        by_words["com_offset", "offset (0.006, 0.008, 0) m"].offset
    ) == pytest.approx(0.01)


def test_sweeps_begin_at_the_vehicle_as_it_is_and_grow():
    for sweep in sweeps(VEHICLE):
        first, *rest = sweep_conditions(VEHICLE, sweep)
        assert first.vehicle is VEHICLE and first.noise == SensorNoise() and len(rest) >= 4
        assert list(sweep.sizes) == sorted(set(sweep.sizes))
        seen = [(repr(c.vehicle), c.noise) for c in (first, *rest)]
        assert len(set(seen)) == len(seen), sweep.name
    named = {sweep.name: sweep for sweep in sweeps(VEHICLE)}
    assert named["motor lag"].sizes[0] == pytest.approx(30)
    assert named["latency"].sizes[0] == pytest.approx(30)
    heavy, _ = named["mass"].make(VEHICLE, 40)
    assert heavy.effects["mass_offset"].offset == pytest.approx(0.3)
    drag, _ = named["drag"].make(VEHICLE, 4)
    assert drag.effects["linear_drag"].coefficient == pytest.approx((0.72, 0.72, 2.88))
    assert drag.effects["quadratic_drag"].coefficient == pytest.approx((0.04, 0.04, 0.16))
    late, _ = named["latency"].make(VEHICLE, 80)
    assert late.effects["command_delay"].delay == pytest.approx(0.08)
    _, noise = named["state-estimation noise"].make(VEHICLE, 2)
    assert (noise.pos_m, noise.vel) == pytest.approx((0.06, 0.2))
    assert noise.attitude_rad == pytest.approx(np.radians(2)) and noise.correlation_s == 0.5


def test_sweeps_of_a_vehicle_with_effects_begin_at_those():
    own = with_effects(VEHICLE, mass_offset=(0.15,), constant_wind=((3.0, -4.0, 0.0),))
    named = {sweep.name: sweep for sweep in sweeps(own)}
    assert named["mass"].sizes == (pytest.approx(20), 40, 60)
    assert named["wind"].sizes == (5.0, 6, 8)
    heavy = sweep_conditions(own, named["mass"])[1].vehicle
    assert heavy.effects["mass_offset"].offset == pytest.approx(0.3)


def test_the_cache_is_named_by_all_code_that_flies(tmp_path, monkeypatch):
    for room, name in (("eval", "judge.py"), ("eval", "view/video.py"), ("suite", "cli.py")):
        path = tmp_path / room / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("one")
    monkeypatch.setattr(cache, "ROOT", tmp_path)
    code_digest.cache_clear()

    def now():
        code_digest.cache_clear()
        return code_digest("eval")

    first = now()
    (tmp_path / "suite" / "cli.py").write_text("two")
    (tmp_path / "eval" / "view" / "video.py").write_text("two")
    assert now() == first, "neither flies"
    (tmp_path / "eval" / "judge.py").write_text("two")
    second = now()
    (tmp_path / "eval" / "judge.py").rename(tmp_path / "eval" / "jury.py")
    assert len({first, second, now()}) == 3
    code_digest.cache_clear()
    assert digest({"a": 1}) != digest({"a": 2}) and len(digest(VEHICLE)) == 16
