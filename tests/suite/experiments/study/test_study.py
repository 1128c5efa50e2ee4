"""The study by hand: order, effects and sweeps; the validation on worlds built by hand."""

from dataclasses import replace
from functools import partial
from importlib.metadata import EntryPoint, EntryPoints

import jax.numpy as jnp
import numpy as np
import pytest

from eval.effects import EFFECTS
from eval.effects.interface import bound_value
from eval.quadrotor.vehicle_file import load_vehicle, shipped_vehicles
from eval.sensors.sensors_file import PERFECT, sensor_set
from suite.common import curve
from suite.common.console import Silent
from suite.common.provenance import added_digest
from suite.experiments.study import cache, training, validation
from suite.experiments.study.cache import Workspace, code_digest, digest, page_code
from suite.experiments.study.conditions import effect_conditions, sweep_conditions, sweeps
from suite.experiments.study.training import Setting, UnseenWorlds, read_measurements
from suite.train.recipes import named_recipe
from suite.train.step import BODY_RADIUS_M
from suite.train.worlds import sample_worlds
from tests.support.training import fresh_params, small_config, straight_worlds
from tests.support.vehicles import with_effects
from tracks.common import names as registry

VEHICLE = load_vehicle("reference")
RECIPE = named_recipe("race-paper")


def test_rows_take_turns_where_they_are_to_meet_the_same_load(tmp_path, monkeypatch):
    rows, unseen = [Setting("a", "", RECIPE), Setting("b", "", RECIPE)], UnseenWorlds(0, 3, 9, 1.0)
    monkeypatch.setattr(training, "do_jobs", lambda do, jobs, *_: [("", [])] * len(jobs))

    def order(**options):
        place = Workspace(tmp_path, tmp_path), Silent()
        runs = training.train_all(rows, (4, 5), unseen, *place, **options)
        return [(run.setting, run.seed) for run in runs]

    assert order() == [("a", 4), ("a", 5), ("b", 4), ("b", 5)]
    assert order(by_seed=True) == [("a", 4), ("b", 4), ("a", 5), ("b", 5)]


def test_time_leaves_compilation_out(tmp_path):
    seconds = [(0, 30.0, True), (1, 2.0, False), (2, 11.0, True), (3, 3.0, False), (4, 4.0, False)]
    rows = [{"iteration": k, "seconds": s, "cold": cold} for k, s, cold in seconds]
    curve.append(tmp_path, rows)
    watched = [{"iteration": k, "gates": float(k)} for k in (0, 3, 5)]
    curve.append(tmp_path, watched, curve.WATCHED)
    points, compiling = read_measurements(tmp_path, 10)
    assert [(p["steps"], p["time"], p["gates"]) for p in points] == [
        (0, 0.0, 0.0), (30, 3 + 2 + 3, 3.0), (50, 3 + 2 + 3 + 3 + 4, 5.0),
    ]  # fmt: skip
    assert compiling == 27 + 8


def test_the_cache_is_named_by_all_code_that_flies(tmp_path, monkeypatch):
    names = ("eval/judge.py", "eval/view/video.py", "suite/cli.py")
    judge, video, command = (tmp_path / name for name in names)
    for path in (judge, video, command):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("a = 1")
    monkeypatch.setattr(cache, "ROOT", tmp_path)
    now = partial(code_digest.__wrapped__, "eval")
    first = now()
    command.write_text("a = 2")
    video.write_text("a = 2")
    assert now() == first, "neither flies"
    judge.write_text('"""Words."""\na = (1)  # one')
    assert now() == first, "the statements are the same"
    judge.write_text("a = 2")
    second = now()
    parts = code_digest.__wrapped__("eval/view")
    video.write_text("a = 3")
    assert code_digest.__wrapped__("eval/view") != parts, "a named folder counts"
    judge.rename(judge.with_name("jury.py"))
    assert len({first, second, now()}) == 3
    # A page also depends on the shipped vehicles; comments in their files do not count.
    monkeypatch.setattr(cache, "code_digest", code_digest.__wrapped__)
    vehicle, pages = tmp_path / "eval" / "vehicles" / "reference.toml", []
    vehicle.parent.mkdir()
    for text in ("mass = 0.75", "mass = 0.75  # kg", "mass = 0.8"):
        vehicle.write_text(text)
        pages.append(page_code("table2"))
    assert pages[0] == pages[1] != pages[2]
    assert digest({"a": 1}) != digest({"a": 2}) and len(digest(load_vehicle("reference"))) == 16


def test_the_cache_is_named_by_what_other_packages_add(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "_installed", lambda: EntryPoints([]))
    assert added_digest() is None
    monkeypatch.syspath_prepend(tmp_path)
    single, package = tmp_path / "extra_drag.py", tmp_path / "extra_tracks" / "spiral.py"
    package.parent.mkdir()
    for path in (single, package, package.with_name("__init__.py")):
        path.write_text("FORCE = 1")
    rows = [
        ("drag", "extra_drag:FORCE", "diffracing_suite.effects"),
        ("spiral", "extra_tracks.spiral:FORCE", "diffracing_suite.tracks"),
        ("gone", "extra_gone:FORCE", "diffracing_suite.tracks"),
        ("other", "extra_other:FORCE", "another_program.effects"),
    ]
    entries = EntryPoints(EntryPoint(*row) for row in rows)
    monkeypatch.setattr(registry, "_installed", lambda: entries)
    found = [added_digest()]
    for path in (single, package):
        path.write_text("FORCE = 2")
        found.append(added_digest())
    assert None not in found and len(set(found)) == 3
    assert [entry.name for entry in registry.added_entries()] == ["drag", "gone", "spiral"]


def test_every_effect_that_touches_a_flight_is_flown_at_its_usual_size():
    conditions = effect_conditions(VEHICLE)
    flown = {condition.name for condition in conditions}
    assert set(EFFECTS) - flown == {
        "lever_arm",
        "attitude_offset",
        "gyro_bias",
        "accelerometer_bias",
        "clock_offset",
    }
    for condition in conditions:
        others, own = dict(condition.vehicle.effects), dict(VEHICLE.effects)
        assert others.pop(condition.name) != own.pop(condition.name, None), condition.name
        assert others == own and condition.sensors == PERFECT
    by_words = {(c.name, c.size_text): c.vehicle.effects[c.name] for c in conditions}
    # The vehicle has drag of its own; what is more of the two stays, axis by axis.
    assert by_words["linear_drag", "coefficient (0.5, 0.5, 0.72) 1/s"].coefficient[2] == 0.72
    assert by_words["motor_lag", "time_constant 0.06 s"].time_constant == 0.06
    for scale in (0.85, 1.15):
        assert by_words["thrust_scale", f"scale {scale}"].scale == pytest.approx(scale)
    assert by_words["weak_motor", "scale (0.85, 1, 1, 1)"].scale[0] == pytest.approx(0.85)
    assert np.linalg.norm(by_words["constant_wind", "velocity (-3, 4, 0) m/s"].velocity) == 5
    # What a vehicle says of an effect besides its size stays.
    given = {"gusts": (3.0, 9.0), "slung_load": (0.05, 2.0), "ground_effect": (1.0, 0.09)}
    flown = effect_conditions(with_effects(VEHICLE, **given))
    values = {condition.name: condition.vehicle.effects[condition.name] for condition in flown}
    assert values["gusts"] == (3.0, 9.0)
    assert {c.name: c.size for c in flown}["gusts"] == 3.0
    assert values["slung_load"] == (0.1, 2.0) and values["ground_effect"] == (8.0, 0.09)


def test_sweeps_begin_at_the_vehicle_as_it_is_and_grow():
    for sweep in sweeps(VEHICLE):
        first, *rest = sweep_conditions(VEHICLE, sweep)
        assert first.vehicle is VEHICLE and first.sensors == PERFECT and len(rest) >= 4
        assert list(sweep.sizes) == sorted(set(sweep.sizes))
        seen = [(repr(c.vehicle), repr(c.sensors)) for c in (first, *rest)]
        assert len(set(seen)) == len(seen), sweep.name
    named = {sweep.name: sweep for sweep in sweeps(VEHICLE)}
    assert named["motor lag"].sizes[0] == named["latency"].sizes[0] == pytest.approx(30)
    heavy, drag, late = (
        named[name].make(size).effects
        for name, size in (("mass", 40), ("drag", 4), ("latency", 80))
    )
    assert heavy["mass_offset"].offset == pytest.approx(0.3)
    assert drag["linear_drag"].coefficient == pytest.approx((0.72, 0.72, 2.88))
    assert drag["quadratic_drag"].coefficient == pytest.approx((0.04, 0.04, 0.16))
    assert late["command_delay"].delay == pytest.approx(0.08)
    sensors = named["jittering age of both"].make(40)
    assert sensors == sensor_set({"delay": {"state": 0.04, "image": 0.04, "jitter": 1.0}})
    values = named["state-estimation noise"].make(2).models["state_noise"]
    assert (values.position, values.velocity) == pytest.approx((0.06, 0.2))
    assert values.attitude == pytest.approx(np.radians(2)) and values.correlation == 0.5


def test_no_effect_is_beyond_what_a_vehicle_may_have():
    """The usual sizes are those of 0.5 to 1 kg; 27 g less 0.2 kg would be no vehicle at all."""
    for vehicle in map(load_vehicle, shipped_vehicles()):
        for condition in effect_conditions(vehicle):
            parameter = EFFECTS[condition.name].parameters[0]
            value = np.array(getattr(condition.vehicle.effects[condition.name], parameter.name))
            low, high = (bound_value(end, vehicle) for end in (parameter.low, parameter.high))
            assert np.all((low <= value) & (value <= high)), (vehicle.name, condition.size_text)


def test_sweeps_of_a_vehicle_with_effects_begin_at_those():
    own = {"mass_offset": (0.15,), "constant_wind": ((3.0, -4.0, 0.0),), "motor_lag": (0.2,)}
    own |= {"linear_drag": ((0.2, 0.2, 0.7),), "rotor_drag": (1e-5,)}
    vehicle = with_effects(VEHICLE, **own)
    named = {sweep.name: sweep for sweep in sweeps(vehicle)}
    assert named["mass"].sizes == (pytest.approx(20), 40, 60)
    assert named["wind"].sizes == (5.0, 6, 8)
    assert named["motor lag"].sizes == pytest.approx((200, 300, 400)), "it still grows"
    heavy = sweep_conditions(vehicle, named["mass"])[1].vehicle
    assert heavy.effects["mass_offset"].offset == pytest.approx(0.3)
    more = named["drag"].make(4)
    assert more.effects["rotor_drag"].coefficient == pytest.approx(4e-5)
    assert more.effects["linear_drag"].coefficient == pytest.approx((0.8, 0.8, 2.8))
    assert "quadratic_drag" not in more.effects
    # Where there is no drag it comes anew.
    bare = load_vehicle("crazyflie21")
    (sweep,) = (sweep for sweep in sweeps(bare) if sweep.name == "drag")
    drags = [c.vehicle.effects.get("linear_drag") for c in sweep_conditions(bare, sweep)]
    assert drags == [None, *(((size,) * 3,) for size in (0.5, 1, 2, 4))]
    assert sweep.axis == "linear drag, each axis [1/s]"


CONFIG = small_config(
    batch=2, gates=2, physics={"drag": (0.0, 0.0), "wind_std": (0, 0, 0), "time_step_std": 0.0}
)
FLOWN = validation.validation_worlds(CONFIG, 2, 9, 1.0)
SPEED = 6.0


def params():
    """Return a policy that never accelerates: it coasts."""
    return {k: v * (k.split(".")[0] != "action") for k, v in fresh_params().items()}


def note(worlds, before, body, target):
    return jnp.ones_like(body.pos_w[:, 0]) * (1 + target)


@pytest.fixture(scope="module")
def measure():
    """Return a function from worlds to what coasting through them comes to."""
    flight = validation.make_flight(FLOWN, note)
    return lambda worlds: validation.mean_scores(flight(params(), worlds))


def straight(wall_x=50.0):
    """Return two worlds: gates 2 m and 4 m ahead, 6 m/s, and a wall across the second's path."""
    return straight_worlds(sample_worlds(FLOWN, 0), SPEED, wall_x)


@pytest.mark.extended
def test_a_straight_flight_through_two_gates_is_a_success_and_a_wall_before_the_last_a_collision(
    measure,
):
    numbers = measure(straight())
    assert numbers["success_cross"] == numbers["collision_free"] == 1.0
    assert numbers["gates"] == 2 and numbers["v_max"] == pytest.approx(SPEED)
    # 0.2 m a step: the first gate in step 10 or 11 and the last in step 20 or 21, the trial's end.
    assert numbers["reward"] == pytest.approx(10 * 1 + 10 * 2, abs=2)
    numbers = measure(straight(wall_x=3.0))
    assert numbers["success_cross"] == numbers["collision_free"] == 0.5
    assert numbers["gates"] == 1.5 and numbers["v_max"] == pytest.approx(SPEED)
    assert measure(straight(wall_x=5.5))["collision_free"] == 1.0
    falling = straight()._replace(vel_w=np.array([[0, 0, -20]] * 2, np.float32))
    numbers = measure(falling)
    assert numbers["collision_free"] == numbers["success_cross"] == numbers["gates"] == 0.0


def test_scores_by_hand():
    clear, near = 1.0, BODY_RADIUS_M - 1e-3
    passed = np.array([[1, 1, 0, 1], [1, 0, 0, 1], [0, 1, 0, 0], [1, 1, 0, 0]], bool)
    clearance = np.array(
        [[clear] * 4, [clear, near, clear, near], [near, clear, clear, clear], [clear] * 4]
    )
    speed = np.array([[1.0, 4, 2, 1], [2, 5, 3, 2], [9, 9, 4, 9], [9, 9, 1, 9]])
    arrays = jnp.asarray(passed), jnp.asarray(clearance), jnp.asarray(speed)
    found = validation.score_trials(*arrays, 2, jnp.ones((4, 4)))
    # Both gates in two steps, a hit after it; a hit in step two; nothing; both in one step.
    assert found.gates.tolist() == [2, 1, 0, 1]
    assert found.crossed.tolist() == [True, False, False, False]
    assert found.collided.tolist() == [False, True, False, True]
    assert found.v_max.tolist() == [2, 5, 4, 2]
    assert found.reward.tolist() == [2, 2, 4, 2]


def test_worlds_are_fresh_fixed_and_all_at_rest():
    config = validation.validation_worlds(CONFIG, 5, 9, 2.0)
    one, two = sample_worlds(config, 0), sample_worlds(config, 0)
    assert np.array_equal(one.pos_w, two.pos_w) and not one.vel_w.any() and not one.target.any()
    assert one.scene.gates.center_w.shape[:2] == (5, 2) and config.episode.steps == 60
    assert (one.fov_scale == 1).all()
    trained = sample_worlds(validation.validation_worlds(CONFIG, 5, CONFIG.seed, 2.0), 0)
    assert not np.array_equal(one.pos_w, trained.pos_w)
    # A policy that takes a speed is commanded its own.
    spec = replace(CONFIG.spec, speed_input=True)
    asked = replace(CONFIG, spec=spec, episode=replace(CONFIG.episode, race_share=0.5))
    worlds = sample_worlds(validation.validation_worlds(asked, 40, 9, 2.0), 0)
    assert np.all(np.asarray(worlds.speed_command) == spec.speed)
