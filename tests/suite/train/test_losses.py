"""Every loss term against its equation and finite differences; the field; what is cut."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from suite.train import losses
from suite.train.config import LossConfig
from suite.train.losses import MAX_PULL
from suite.train.step import Step, gap_beyond
from tracks.geometry.clearance import nearest_obstacle
from tracks.geometry.field import attractive_field, magnetic_field
from tracks.geometry.gates import square_gates
from tracks.geometry.scene import Boxes, Gates, Rods, Scene, Spheres

pytestmark = pytest.mark.usefixtures("float64")


@pytest.fixture(autouse=True)
def _gentle_barrier(monkeypatch):
    """Let the barrier reach as far as the points that are drawn: the paper's ends after 0.1 m."""
    monkeypatch.setattr(losses, "BARRIER_SLOPE", -8.0)


def one_of_each() -> Scene:
    """Return a batch of one world with a box, a cylinder, a capsule and a sphere, all apart."""
    turn = Rotation.from_euler("ZYX", [0.5, 0.4, -0.3]).as_matrix()
    gates = square_gates(np.array([[50.0, 0, 5]]), *(np.ones(1) * x for x in (0, 1, 0.1, 0.1)))
    axis = turn[:, :1].T
    scene = Scene(
        Gates(*gates),
        Boxes(np.array([[0.0, 0, 5]]), turn[None], np.array([[0.5, 0.3, 0.8]])),
        Rods(np.array([[5.0, 0, 5]]), axis, np.array([0.4]), np.array([0.7])),
        Rods(np.array([[10.0, 0, 5]]), axis, np.array([0.4]), np.array([0.7])),
        Spheres(np.array([[15.0, 0, 5]]), np.array([0.5])),
        np.zeros((0, 3, 3)),
    )
    return jax.tree.map(lambda x: np.asarray(x)[None], scene)


def a_step(batch, **known):
    """Return a step of `batch` worlds at rest before a gate, but for what is `known`."""
    zero = np.zeros((batch, 3))
    rest = {name: zero for name in ("pos_w", "vel_w", "acc_w", "jerk_w", "goal_w", "place_g")}
    path = {"gap": np.ones((batch, 1)), "away_w": zero[:, None], "clearance": np.ones(batch)}
    path |= {"up": np.ones(batch)}
    gate = {"gate": unit_gate(batch), "passed": np.zeros(batch, bool)}
    return Step(**{**rest, **path, **gate, **known})


# As one program each: op by op there is more to compile than to test.
by_config = partial(jax.jit, static_argnums=0)
weighted = by_config(losses.weighted)


@by_config
def obstacle_terms(config, distance, away_w, path_w, vel_w):
    gap = gap_beyond(config, distance, away_w, path_w)
    step = a_step(len(vel_w), gap=gap, away_w=away_w, vel_w=vel_w)
    return losses.clearance(config, step), losses.collide(config, step)


@by_config
def progress_term(config, pos_w, vel_w, goal_w, place_g):
    step = a_step(len(pos_w), pos_w=pos_w, vel_w=vel_w, goal_w=goal_w, place_g=place_g)
    return weighted(config, step)["progress"]


@by_config
def guidance_term(config, gates, pos_w, vel_w):
    return weighted(config, a_step(len(pos_w), gate=gates, pos_w=pos_w, vel_w=vel_w))["guidance"]


def test_every_weight_of_the_table_scales_its_term_alone():
    rng = np.random.default_rng(9)
    names = ("pos_w", "vel_w", "acc_w", "jerk_w", "goal_w", "place_g")
    drawn = {name: jnp.asarray(rng.normal(0, 2, (4, 3))) for name in names}
    step = a_step(4, up=jnp.asarray([1.0, 0.3, 0.0, -0.5]), **drawn)
    terms = [(name, *term) for name, of_it in losses.LOSSES.items() for term in of_it]
    nothing = {weight: 0.0 for _, _, weight in terms}

    @jax.jit
    def each_alone(step):
        configs = [replace(LossConfig(), **{**nothing, weight: 3.0}) for _, _, weight in terms]
        found = [losses.weighted(config, step) for config in configs]
        return list(zip(found, (term(LossConfig(), step) for _, term, _ in terms), strict=True))

    for (name, *_), (found, plain) in zip(terms, each_alone(step), strict=True):
        np.testing.assert_allclose(found[name], 3.0 * plain, rtol=1e-6)
        assert not any(np.any(value) for key, value in found.items() if key != name)


def test_tilt_costs_from_an_angle_on_and_one_where_the_body_lies_level():
    angle = np.radians([0.0, 64.0, 75.0, 90.0, 120.0])
    least = np.cos(np.radians(65.0))

    @jax.jit
    def cost(up):
        return losses.tilt(LossConfig(), a_step(5, up=up))

    up = jnp.asarray(np.cos(angle))
    wanted = [0.0, 0.0, (1 - np.cos(angle[2]) / least) ** 2, 1.0, (1 + 0.5 / least) ** 2]
    np.testing.assert_allclose(cost(up), wanted, atol=1e-6)
    slope = jax.grad(lambda up: cost(up).sum())(up)
    assert np.all(slope[:2] == 0) and np.all(np.diff(slope[1:]) < 0), "the further, the dearer"


nearest = jax.jit(nearest_obstacle)


def around(count=30, seed=0):
    """Return (1, S, 3) points around the four solids' centres, outside and inside."""
    rng = np.random.default_rng(seed)
    center = np.array([0.0, 5, 10, 15])[rng.integers(0, 4, count)]
    point = rng.uniform(-1.0, 1.0, (count, 3)) + [0, 0, 5]
    point[:, 0] += center
    return jnp.asarray(point)[None]


@partial(jax.jit, static_argnums=2)
def terms_at(path_w, vel_w, config):
    """Return both terms (S,), every point being the path of a world of its own."""
    distance, away = nearest(one_of_each(), jax.lax.stop_gradient(path_w))
    points = jnp.swapaxes(path_w, 0, 1)
    vel = jnp.broadcast_to(vel_w, away[0].shape)
    return obstacle_terms(config, distance[0][:, None], away[0][:, None], points, vel)


def test_obstacle_terms_are_the_papers():
    config = LossConfig(safety_radius_m=0.15)
    vel, path = np.array([1.0, 2.0, -1.0]), around()
    distance, away = (np.array(x[0]) for x in nearest(one_of_each(), path))
    gap, closing = distance - 0.15, np.maximum(0.0, -(away @ vel))
    barrier, collide = terms_at(path, jnp.asarray(vel), config)
    np.testing.assert_allclose(barrier, 2.0 * np.log1p(np.exp(-8.0 * gap)), rtol=1e-9)
    np.testing.assert_allclose(collide, closing * np.maximum(1 - gap, 0) ** 2, rtol=1e-9)


def test_the_terms_of_a_step_are_means_over_its_path():
    config, path = LossConfig(), around(4, seed=2)
    vel = jnp.asarray([[1.0, 2.0, -1.0]])
    distance, away = nearest(one_of_each(), path)
    whole = obstacle_terms(config, distance, away, path, vel)
    for term, parts in zip(whole, terms_at(path, vel, config), strict=True):
        assert float(term[0]) == pytest.approx(float(parts.mean()))


@pytest.mark.parametrize("index", [0, 1])
def test_obstacle_gradients_are_those_of_the_true_distance(index):
    """Central differences look the nearest obstacle up again at each moved point."""
    config = LossConfig()
    path, vel = around(40, seed=5), np.array([1.0, -1.5, 0.7])
    gradient = jax.grad(lambda p: terms_at(p, jnp.asarray(vel), config)[index].sum())(path)
    # The closing speed has no gradient on purpose, so the differences hold it as well.
    closing = np.maximum(-(np.array(nearest(one_of_each(), path)[1][0]) @ vel), 0)[:, None]
    direction, step = np.random.default_rng(1).normal(size=(40, 3)), 1e-6
    moved = [path + sign * step * direction for sign in (1, -1)]
    ways = [nearest(one_of_each(), point)[1][0] for point in moved]
    values = [terms_at(p, -closing * a, config)[index] for p, a in zip(moved, ways, strict=True)]
    slope = np.array(values[0] - values[1]) / (2 * step)
    assert np.abs(slope).max() > 0.1
    np.testing.assert_allclose((gradient[0] * direction).sum(-1), slope, rtol=1e-4, atol=1e-6)


def test_the_closing_speed_carries_no_gradient():
    path, away = around(1), jnp.asarray([[[0.0, 0, 1]]])
    config = LossConfig()

    def collide(vel):
        return obstacle_terms(config, jnp.asarray([[0.3]]), away, path, vel)[1].sum()

    vel = jnp.asarray([[0.0, 0.0, -2.0]])
    assert collide(2 * vel) == pytest.approx(2 * float(collide(vel)))
    assert not np.any(jax.grad(collide)(vel))


def test_progress_counts_up_to_the_speed_that_is_asked_for_and_what_is_faster_costs():
    """3 m/s towards the goal where 1, 3.5 and 6 m/s are asked for, the last one without a limit."""
    config = LossConfig(progress=0.4, speed_range=(1.0, 6.0))
    ahead = jnp.broadcast_to(jnp.array([3.0, 0.0, 0.0]), (3, 3))
    step = a_step(3, vel_w=ahead, goal_w=ahead, speed_command=jnp.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(weighted(config, step)["progress"], [0.4, -1.2, -1.2], rtol=1e-6)

    def total(vel):
        return weighted(config, step._replace(vel_w=vel))["progress"].sum()

    pull = jax.grad(total)(ahead)
    np.testing.assert_allclose(pull[:, 0], [0.4, -0.4, -0.4], rtol=1e-6)
    costs = weighted(config, step._replace(vel_w=3 * ahead))["progress"]
    np.testing.assert_allclose(costs, [2.8, 0.8, -3.6], rtol=1e-6)
    fast = jax.grad(total)(3 * ahead)
    np.testing.assert_allclose(fast[:, 0], [0.4, 0.4, -0.4], rtol=1e-6, err_msg="a race has no end")


def test_progress_is_the_papers_and_differentiates():
    config = LossConfig(progress=0.4)
    rng = np.random.default_rng(2)
    pos, vel, target = (jnp.asarray(rng.normal(0, 3, (5, 3))) for _ in range(3))
    to_gate = np.array(target - pos)
    expected = -0.4 * (np.array(vel) * to_gate).sum(-1) / np.linalg.norm(to_gate, axis=-1)
    np.testing.assert_allclose(
        progress_term(config, pos, vel, target, pos - target), expected, atol=1e-9
    )
    by_direction = LossConfig(progress=0.0, progress_norm=0.4)
    expected /= np.linalg.norm(vel, axis=-1) + 1e-3
    found = progress_term(by_direction, pos, vel, target, pos - target)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    for varied in (LossConfig(), by_direction):
        check_grads(
            lambda p, v, c=varied: progress_term(c, p, v, target, pos - target),
            (pos, vel), order=1, modes=["rev"], atol=1e-6, rtol=1e-6,
        )  # fmt: skip


@pytest.mark.parametrize("before_m", [0.0, 1.5])
def test_projection_pulls_to_the_axis_and_its_range_carries_no_gradient(before_m):
    """L_proj = |lateral|^2 exp(-beta_3 distance), where only the lateral part is differentiated.

    The distance is that of the gate, wherever before it progress is measured to.
    """
    config = LossConfig(progress=0.0, projection=1.5, projection_decay=0.5)
    gate, vel = jnp.asarray([[4.0, 0.5, 1.0]]), jnp.asarray([[1.0, 2.0, 3.0]])
    pos, target = jnp.asarray([[1.0, 1.0, 2.0]]), gate - jnp.asarray([[before_m, 0.0, 0.0]])

    def term(pos):
        return progress_term(config, pos, vel, target, pos - gate).sum()

    distance = np.linalg.norm(np.array(pos - gate))
    near = np.exp(-0.5 * distance)
    assert float(term(pos)) == pytest.approx(1.5 * (0.5**2 + 1.0**2) * near)
    expected = 1.5 * 2 * near * np.array([[0, 0.5, 1.0]])
    np.testing.assert_allclose(jax.grad(term)(pos), expected, atol=1e-9)


def test_smoothness_is_the_papers_and_differentiates():
    config = LossConfig(acceleration=0.01, jerk=0.001)
    rng = np.random.default_rng(4)
    acc, before = (jnp.asarray(rng.normal(0, 5, (3, 3))) for _ in range(2))
    dt = jnp.asarray([0.03, 0.04, 0.05])

    @jax.jit
    def terms(acc_w, acc_before_w):
        step = a_step(3, acc_w=acc_w, jerk_w=(acc_w - acc_before_w) / dt[:, None])
        found = weighted(config, step)
        return found["acceleration"], found["jerk"]

    size, change = terms(acc, before)
    np.testing.assert_allclose(size, 0.01 * np.linalg.norm(acc, axis=-1) ** 2)
    rate = np.linalg.norm(np.array(acc - before) / np.array(dt)[:, None], axis=-1)
    np.testing.assert_allclose(change, 0.001 * rate**2)
    check_grads(terms, (acc, before), order=1, modes=["rev"], atol=1e-4, rtol=1e-5)


def unit_gate(count, yaw=0.4):
    ones = np.ones(count)
    gates = square_gates(
        np.tile([1.0, -2.0, 1.5], (count, 1)), yaw * ones, ones, 0.2 * ones, 0.1 * ones
    )
    return Gates(*map(np.asarray, gates))


@partial(jax.jit, static_argnums=0)
def pull_at(config, gates, pos, vel):
    return -jax.grad(lambda p: guidance_term(config, gates, p, vel).sum())(pos)


def test_the_field_enters_as_minus_its_vector_with_the_strength_it_says():
    config = LossConfig(field_gain=0.42)
    gates = unit_gate(20)
    rng = np.random.default_rng(6)
    away = rng.normal(0, 1.0, (20, 3))
    pos = gates.center_w + away
    vel = jnp.asarray(rng.normal(0, 3, (20, 3)))
    term = guidance_term(config, gates, pos, vel)
    np.testing.assert_array_equal(term, np.zeros(20))
    pull = pull_at(config, gates, pos, vel)

    centers, rot, opening = (np.array(x) for x in (gates.center_w, gates.rot_w, gates.opening_g))
    center, sideways = centers[:1], rot[:1, :, 1]
    unit_field = magnetic_field(center, rot[:1], opening[:1], center)
    at_center = attractive_field(unit_field, sideways, 0.3)
    field = magnetic_field(centers, rot, opening, np.array(pos))
    u_a = attractive_field(field, np.array(vel), 0.3)
    expected = 0.42 * u_a / np.linalg.norm(at_center)
    far = np.linalg.norm(expected, axis=-1) < 0.42 * MAX_PULL
    assert far.sum() > 15
    np.testing.assert_allclose(pull[far], expected[far], rtol=1e-6)
    middle = jnp.tile(jnp.asarray(center), (20, 1))
    at = pull_at(config, gates, middle, jnp.tile(jnp.asarray(sideways), (20, 1)))
    np.testing.assert_allclose(at[0], 0.42 * rot[0, :, 0], atol=1e-6)


def test_the_field_is_held_near_the_wires_and_carries_no_gradient_itself():
    config = LossConfig(field_gain=0.42)
    gates = unit_gate(1, yaw=0.0)
    wire = gates.center_w + jnp.asarray([[0.0, 0.5 + 1e-5, 0.0]])
    vel = jnp.asarray([[1.0, 2.0, 0.0]])
    pull = pull_at(config, gates, wire, vel)
    assert np.linalg.norm(pull) == pytest.approx(0.42 * MAX_PULL, rel=1e-6)
    assert np.all(
        np.isfinite(pull_at(config, gates, gates.center_w + jnp.asarray([[0.0, 0.5, 0.5]]), vel))
    )

    def of_velocity(vel):
        return guidance_term(config, gates, wire - 0.3, vel).sum()

    assert not np.any(jax.grad(of_velocity)(vel))
    bend = jax.jacrev(jax.grad(lambda p: guidance_term(config, gates, p, vel).sum()))(wire - 0.3)
    assert not np.any(bend)
