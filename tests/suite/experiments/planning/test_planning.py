"""Plans of the fastest lap: their path, what it must keep, the search, and the judge's flight."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.effects import EFFECTS
from eval.judging.judge import JudgeOptions, Record, fly
from eval.quadrotor.autopilot import make_autopilot
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import with_effects
from eval.worlds.trial import Rules, TrialSpec
from policies.observation import observe, view_of
from suite.experiments.planning import course, first, flown, known, search, solver, spline
from tracks.families import make_track
from tracks.geometry.gates import yaw_rotation
from tracks.geometry.rotation import exp_rot
from tracks.geometry.scene import Gates

TRIAL = TrialSpec("zigzag", 0, 3)


@pytest.fixture(scope="module", autouse=True)
def exact():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def track():
    return make_track(*TRIAL)


@pytest.fixture(scope="module")
def reference():
    return load_vehicle("reference")


def test_a_spline_rests_follows_and_goes_straight_on():
    time_s = np.linspace(0.0, 2.0, 200)
    points = np.stack([time_s**3, np.sin(time_s) * time_s**2, 1.0 + 0.0 * time_s], axis=-1)
    line = spline.fitted(points, 2.0, 1e-3)
    along = jax.jit(spline.along)
    seen = along(line, time_s)
    np.testing.assert_allclose(seen.pos_w, points, atol=5e-3)
    np.testing.assert_allclose(seen.vel_w[0], 0.0, atol=5e-3)
    middle = np.array([0.7, 1.3])
    near = [along(line, middle + d).pos_w for d in (-1e-4, 0.0, 1e-4)]
    found = along(line, middle)
    np.testing.assert_allclose((near[2] - near[0]) / 2e-4, found.vel_w, atol=1e-5)
    np.testing.assert_allclose((near[2] - 2 * near[1] + near[0]) / 1e-8, found.acc_w, atol=1e-3)
    after = along(line, np.array([2.0, 2.5]))
    np.testing.assert_allclose(after.pos_w[1] - after.pos_w[0], 0.5 * after.vel_w[0])
    same = spline.unpacked(spline.packed(line))
    np.testing.assert_array_equal(same.control_w, line.control_w)


def test_a_path_through_the_gates_passes_them_in_order_and_one_beside_them_does_not(track):
    asked, line = course.course_of(track, 0.1), first.guess(track)
    time_s = np.arange(0.0, float(line.duration_s) * 1.05, 0.02)
    pos_w = jax.jit(spline.along)(line, time_s).pos_w
    passing, nearness = jax.jit(course.passing), jax.jit(course.nearness)
    seen = passing(asked, pos_w, 0.02)
    assert (np.diff(seen.time_s) > 0.0).all() and (seen.excess < 0.0).all()
    beside = passing(asked, pos_w + np.array([0.0, 1.5, 0.0]), 0.02)
    assert (beside.excess.max(axis=-1) > 0.0).all()
    gate = track.scene.gates
    points = jnp.stack([gate.center_w[0], track.scene.boxes.center_w[0] + 0.01])
    excess = nearness(asked, points)
    assert excess[0] < 0.0 < excess[1]
    _, slope = jax.jvp(lambda at: nearness(asked, at), (points,), (jnp.ones_like(points),))
    near = (nearness(asked, points + d) for d in (1e-6, -1e-6))
    np.testing.assert_allclose(slope[1], np.subtract(*near)[1] / 2e-6, atol=1e-3)


def test_the_first_plan_counts_what_a_path_asks_for(track):
    asked, line = course.course_of(track, 0.1), first.guess(track)
    judge = jax.jit(first.first_plan)
    rest = asked, first.Limits(26.0, 3.0, 4.0, 0.15)
    slow = judge(spline.packed(line), rest)
    assert abs(slow.time_s - line.duration_s) < 0.1 and slow.excess.max() <= 0.0
    fast = line._replace(duration_s=0.25 * line.duration_s)
    hard = judge(spline.packed(fast), rest)
    assert abs(hard.time_s - fast.duration_s) < 0.05 and hard.excess.max() > 1.0


def test_the_search_finds_the_least_time_that_the_limits_allow():
    """1 m at no more than 2 m/s, and at no more than 4 m/s; the first step would break both."""

    def problem(numbers, most):
        time_s, far_m = numbers
        excess = 100.0 * (far_m - most * time_s)[None]
        return solver.Judged(time_s, excess, 100.0 * (far_m - 1.0)[None], numbers)

    start, most = np.array([[2.0, 0.5], [2.0, 0.5]]), np.array([2.0, 4.0])
    now = solver.begin(start, jax.vmap(problem)(start, most))
    step = jax.jit(lambda now: solver.step(problem, now, most))
    costs = [now.cost]
    for _ in range(12):
        now = step(now)
        costs.append(now.cost)
    np.testing.assert_allclose(now.numbers, [[0.5, 1.0], [0.25, 1.0]], atol=2e-3)
    assert np.diff(np.stack(costs), axis=0).max() <= 0.0


def test_the_judge_flies_a_plan_as_the_model_says(track, reference):
    """On a battery that sags, too: a plan's time is the flight's."""
    sags = EFFECTS["battery_sag"].values(rate=0.05, per_volt=0.0)
    reference = with_effects(reference, {"battery_sag": sags})
    line = first.guess(track)
    line = line._replace(duration_s=0.5 * line.duration_s)
    policy = known.PlannedPolicy(track, np.asarray(spline.packed(line)), 100.0)
    with pytest.raises(ValueError, match="give the judge slots=1"):
        policy.start(2)
    flights = []
    options = JudgeOptions(slots=1, workers=1, rules=Rules(time_limit_s=1.0))
    keep = lambda _, flight: flights.append(flight)  # noqa: E731
    fly(policy, [TRIAL], reference, "mujoco", options, keep, Record())
    (flight,) = flights
    assert flight.gate.max() >= 1, "the heading has turned to another gate"
    passed_s = flight.time_s[[np.argmax(flight.gate > k) or -1 for k in range(8)]]
    autopilot, asked = make_autopilot(reference), course.course_of(track, 0.1)
    fly_model = jax.jit(lambda line: flown.fly(autopilot, asked, line, passed_s - 1e-6, 100))
    seen = fly_model(line)
    np.testing.assert_allclose(seen.pos_w, flight.pos_w[:101], atol=1e-4)
    np.testing.assert_allclose(seen.vel_w, flight.vel_w[:101], atol=1e-3)


def test_where_the_drone_is_follows_from_what_it_sees(track):
    gates = track.scene.gates
    rot_w = yaw_rotation(0.7) @ exp_rot(np.array([0.4, -0.3, 0.2]))
    pos_w = np.array([1.0, 0.4, 1.2])
    for number in (1, 6):
        gate = Gates(*(field[number] for field in gates))
        view = view_of(pos_w, rot_w, np.zeros(3), gate, gate, None)
        spec = known.PlannedPolicy(track, np.asarray(spline.packed(first.guess(track))), 100.0).spec
        state = observe(spec, view, np.zeros(3)).state
        place_w, turned_w = known.place(gates, state, pos_w + 0.2)
        np.testing.assert_allclose(place_w, pos_w, atol=1e-9)
        np.testing.assert_allclose(turned_w, rot_w, atol=1e-9)


def test_what_fails_in_mujoco_is_planned_with_more_room_and_the_fastest_counts(
    monkeypatch, reference
):
    """Of two tracks one is flown at once, by both plans; the other at the second try, by one."""
    rooms, endings = [], {0: iter([(True, 3.0), (True, 2.5)])}
    endings[1] = iter([(False, 1.0), (False, 2.0), (True, 4.0), (False, 0.5)])

    def do(at, rest, what, *more):
        courses, passed_s = rest
        if what == "step":
            return at
        rooms.append(np.asarray(courses.room_m))
        none = np.zeros((len(at), 1))
        return solver.Judged(np.ones(len(at)), none, none, none), passed_s

    def fly_plan(vehicle, trial, numbers):
        success, time_s = next(endings[trial.seed])
        return SimpleNamespace(success=success, time_s=time_s, ending="as told"), None

    judged = solver.Judged(*np.zeros((4, 4, 1)))
    monkeypatch.setattr(search, "_flown", do)
    monkeypatch.setattr(search, "fly_plan", fly_plan)
    line = spline.Spline(np.zeros((spline.INTERVALS + 3, 3)), np.float64(5.0))
    monkeypatch.setattr(search, "guess", lambda track: line)
    monkeypatch.setattr(search, "_passed", lambda *seen: np.ones((4, 8)))
    monkeypatch.setattr(search, "_first_judged", lambda numbers, rest: judged)
    monkeypatch.setattr(search, "_first_step", lambda now, rest: now)
    trials = [TrialSpec("zigzag", 0, seed) for seed in (0, 1)]
    told = []
    found = search.plans(reference, trials, search.Effort(2, 4, 2, 3), told.append)
    assert [(plan.trial.seed, plan.flown, plan.lap_s) for plan in found] == [
        (0, True, 2.5),
        (1, True, 4.0),
    ]
    assert told == sorted(told) and told[-1] == 6
    more = rooms[-1] - rooms[0]
    np.testing.assert_allclose(more, [0.0, 0.0, search.MORE_ROOM_M, search.MORE_ROOM_M])
    assert len(found[0].numbers) == spline.NUMBERS
