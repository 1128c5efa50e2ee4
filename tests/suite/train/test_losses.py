"""Every loss term against its equation and finite differences; the field; what is cut."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from suite.train import losses
from suite.train.config import LossConfig
from suite.train.losses import MAX_PULL
from suite.train.step import Step, margin_of
from tracks.geometry.field import attractive_field, magnetic_field
from tracks.geometry.gates import square_gates
from tracks.geometry.scene import Gates

pytestmark = pytest.mark.usefixtures("float64")


@pytest.fixture(autouse=True)
def _gentle_barrier(monkeypatch):
    """Let the barrier reach as far as the points that are drawn: the paper's ends after 0.1 m."""
    monkeypatch.setattr(losses, "BARRIER_SLOPE", -8.0)


def a_step(batch, **known):
    """Return a step of `batch` worlds at rest before a gate, but for what is `known`."""
    zero = np.zeros((batch, 3))
    rest = {name: zero for name in ("pos_w", "vel_w", "acc_w", "jerk_w", "goal_w", "place_g")}
    path = {"margin": np.ones((batch, 1)), "away_w": zero[:, None], "clearance": np.ones(batch)}
    path |= {"up": np.ones(batch)}
    gate = {"gate": unit_gate(batch), "passed": np.zeros(batch, bool)}
    return Step(**{**rest, **path, **gate, **known})


# As one program each: op by op there is more to compile than to test.
by_config = partial(jax.jit, static_argnums=0)
weighted = by_config(losses.weighted)


@by_config
def obstacle_terms(config, distance, away_w, path_w, vel_w):
    margin = margin_of(config, distance, away_w, path_w)
    step = a_step(len(vel_w), margin=margin, away_w=away_w, vel_w=vel_w)
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


def from_sphere(point_w):
    """Return the distance of points (..., 3) to a sphere of 0.5 m, and the way from it."""
    radius = jnp.linalg.norm(point_w, axis=-1)
    return radius - 0.5, point_w / radius[..., None]


@partial(jax.jit, static_argnums=2)
def terms_at(path_w, vel_w, config):
    """Return both terms (N,) at points (N, 3), each of which is the path of a world of its own."""
    distance, away_w = from_sphere(jax.lax.stop_gradient(path_w))
    now = distance[:, None], away_w[:, None], path_w[:, None]
    return obstacle_terms(config, *now, jnp.broadcast_to(vel_w, path_w.shape))


def around(count, seed):
    """Return points (N, 3) outside and inside the sphere."""
    return jnp.asarray(np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 3)))


def test_obstacle_terms_are_the_papers_and_means_over_the_path_of_a_step():
    config = LossConfig(safety_radius_m=0.15)
    vel, path = jnp.array([1.0, 2.0, -1.0]), around(30, seed=0)
    distance, away_w = map(np.array, from_sphere(path))
    margin, closing = distance - 0.15, np.maximum(0.0, -(away_w @ vel))
    barrier, collide = terms_at(path, vel, config)
    np.testing.assert_allclose(barrier, 2.0 * np.log1p(np.exp(-8.0 * margin)), rtol=1e-9)
    np.testing.assert_allclose(collide, closing * np.maximum(1 - margin, 0) ** 2, rtol=1e-9)
    slope = jax.grad(lambda vel: terms_at(path, vel, config)[1].sum())(vel)
    assert not np.any(slope), "the closing speed carries no gradient"
    config, path, vel = LossConfig(), around(4, seed=2), jnp.asarray([1.0, 2.0, -1.0])
    distance, away_w = from_sphere(path[None])
    whole = obstacle_terms(config, distance, away_w, path[None], vel[None])
    for term, parts in zip(whole, terms_at(path, vel, config), strict=True):
        assert float(term[0]) == pytest.approx(float(parts.mean()))


@pytest.mark.parametrize("index", [0, 1])
def test_obstacle_gradients_are_those_of_the_true_distance(index):
    """Central differences look the distance up again at each moved point."""
    config, path, vel = LossConfig(), around(40, seed=5), jnp.array([1.0, -1.5, 0.7])
    gradient = jax.grad(lambda p: terms_at(p, vel, config)[index].sum())(path)
    # The closing speed has no gradient on purpose, so the differences hold it as well.
    closing = jnp.maximum(-(from_sphere(path)[1] @ vel), 0)[:, None]
    direction, step = np.random.default_rng(1).normal(size=(40, 3)), 1e-6
    ahead, behind = (
        terms_at(moved, -closing * from_sphere(moved)[1], config)[index]
        for moved in (path + step * direction, path - step * direction)
    )
    slope = np.array(ahead - behind) / (2 * step)
    assert np.abs(slope).max() > 0.1
    np.testing.assert_allclose((gradient * direction).sum(-1), slope, rtol=1e-4, atol=1e-6)


def test_progress_counts_up_to_the_commanded_speed_and_a_faster_flight_costs():
    """3 and 9 m/s towards the goal, where 1 and 3.5 m/s are commanded, and no limit."""
    config = LossConfig(progress=0.4, speed_range=(1.0, 6.0))
    ahead = jnp.broadcast_to(jnp.array([3.0, 0.0, 0.0]), (3, 3))
    step = a_step(3, goal_w=ahead, speed_command=jnp.array([0.0, 0.5, 1.0]))

    def total(vel_w):
        term = weighted(config, step._replace(vel_w=vel_w))["progress"]
        return term.sum(), term

    for factor, terms, slopes in (
        (1, [0.4, -1.2, -1.2], [0.4, -0.4, -0.4]),
        (3, [2.8, 0.8, -3.6], [0.4, 0.4, -0.4]),
    ):
        pull, found = jax.grad(total, has_aux=True)(factor * ahead)
        np.testing.assert_allclose(found, terms, rtol=1e-6)
        np.testing.assert_allclose(pull[:, 0], slopes, rtol=1e-6)


def test_progress_and_smoothness_are_the_papers_and_progress_differentiates():
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
    acc, jerk = np.random.default_rng(4).normal(0, 5, (2, 3, 3))
    step = a_step(3, acc_w=jnp.asarray(acc), jerk_w=jnp.asarray(jerk))
    found = weighted(LossConfig(acceleration=0.01, jerk=0.001), step)
    np.testing.assert_allclose(found["acceleration"], 0.01 * np.linalg.norm(acc, axis=-1) ** 2)
    np.testing.assert_allclose(found["jerk"], 0.001 * np.linalg.norm(jerk, axis=-1) ** 2)


def test_projection_pulls_to_the_axis_and_its_range_carries_no_gradient():
    """L_proj = |lateral|^2 exp(-beta_3 distance to the gate, not to the goal before it)."""
    config = LossConfig(progress=0.0, projection=1.5, projection_decay=0.5)
    gate, vel = jnp.asarray([[4.0, 0.5, 1.0]]), jnp.asarray([[1.0, 2.0, 3.0]])
    pos, target = jnp.asarray([[1.0, 1.0, 2.0]]), gate - jnp.asarray([[1.5, 0.0, 0.0]])

    def term(pos):
        return progress_term(config, pos, vel, target, pos - gate).sum()

    distance = np.linalg.norm(np.array(pos - gate))
    near = np.exp(-0.5 * distance)
    assert float(term(pos)) == pytest.approx(1.5 * (0.5**2 + 1.0**2) * near)
    expected = 1.5 * 2 * near * np.array([[0, 0.5, 1.0]])
    np.testing.assert_allclose(jax.grad(term)(pos), expected, atol=1e-9)


def unit_gate(count, yaw=0.4):
    center_w, one = np.tile([1.0, -2.0, 1.5], (count, 1)), np.ones(count)
    return Gates(*map(np.asarray, square_gates(center_w, yaw * one, one, 0.2 * one, 0.1 * one)))


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
    at = pull_at(config, gates, jnp.asarray(centers), jnp.asarray(rot[:, :, 1]))
    np.testing.assert_allclose(at[0], 0.42 * rot[0, :, 0], atol=1e-6)


def test_the_field_is_held_near_the_wires_and_carries_no_gradient_itself():
    config = LossConfig(field_gain=0.42)
    gates = unit_gate(1, yaw=0.0)
    vel, corner = jnp.asarray([[1.0, 2.0, 0.0]]), gates.center_w + jnp.asarray([[0.0, 0.5, 0.5]])
    wire = gates.center_w + jnp.asarray([[0.0, 0.5 + 1e-5, 0.0]])
    pull = pull_at(config, gates, wire, vel)
    assert np.linalg.norm(pull) == pytest.approx(0.42 * MAX_PULL, rel=1e-6)
    assert np.isfinite(pull_at(config, gates, corner, vel)).all()

    def of_velocity(vel):
        return guidance_term(config, gates, wire - 0.3, vel).sum()

    assert not np.any(jax.grad(of_velocity)(vel))
    bend = jax.jacrev(jax.grad(lambda p: guidance_term(config, gates, p, vel).sum()))(wire - 0.3)
    assert not np.any(bend)
