"""Worlds and sensor models of an iteration follow the settings, and come in order."""

import threading
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.sensors import SENSORS
from eval.sensors.sensors_file import load_sensors, sensor_set
from suite.commands.train import Config, resolve
from suite.delta.replay import nominal_model
from suite.train import worlds as sampling
from suite.train.config import SensorsConfig
from suite.train.dynamics.interface import make_dynamics
from suite.train.rollout import SEEN, Observer, delayed_view, view_in, world_keys
from suite.train.step import NEAR
from suite.train.worlds import WorldsAhead, sample_worlds
from tests.support.training import KEY, boxes_worlds, small_config
from tracks.families import FAMILIES, MAX_COUNTS, make_track
from tracks.geometry.camera import Camera, pixel_rays_b
from tracks.geometry.clearance import nearest_obstacle
from tracks.geometry.depth import depth_image
from tracks.geometry.rotation import exp_rot, yaw_rotation
from tracks.geometry.scene import stack


def test_gates_heights_and_drag_along_the_bodys_z_follow_settings_of_their_own():
    usual, wide = (
        sample_worlds(small_config(batch=16, height_spread=share), 0).scene.gates.center_w[..., 2]
        for share in (1.0, 2.0)
    )
    assert np.ptp(wide, axis=1).mean() > 1.4 * np.ptp(usual, axis=1).mean()
    config = small_config()
    plain = sample_worlds(config, 2)
    physics = replace(config.physics, drag_up=(3.0, 4.0))
    changed = sample_worlds(replace(config, physics=physics), 2)
    before, after = (worlds.constants for worlds in (plain, changed))
    np.testing.assert_array_equal(after.drag[:, :2], before.drag[:, :2])
    assert np.all((after.drag[:, 2] >= 3.0) & (after.drag[:, 2] <= 4.0))
    np.testing.assert_array_equal(changed.pos_w, plain.pos_w)
    np.testing.assert_allclose(nominal_model(physics).drag, [0.45, 0.45, 3.5])


@pytest.mark.parametrize(("share", "least", "most"), [(0.5, 0.35, 0.65), (1.0, 0.9, 1.0)])
def test_as_many_have_missed_a_gate_as_are_asked_for(share, least, most):
    config = small_config(batch=80, rest_share=0.0, missed_share=share, start_speed=5.0)
    worlds = sample_worlds(config, 3)
    gates, rows = worlds.scene.gates, np.arange(80)
    turn = gates.rot_w[rows, worlds.target]
    local = np.einsum("bij,bi->bj", turn, worlds.pos_w - gates.center_w[rows, worlds.target])
    beside = np.hypot(local[:, 1], local[:, 2])
    missed = (np.abs(local[:, 0] - 0.25) < 0.96) & (beside > 0.85) & (beside < 1.85)
    assert least <= missed.mean() <= most
    if share == 1.0:
        assert np.all(np.abs(local[:, 0] - 0.25) < 0.96)
        assert np.all(local[:, 2] < 1.81) and np.any(local[:, 2] > 1.0)
        assert np.linalg.norm(worlds.vel_w, axis=-1).max() < 5.0


def test_the_speed_command_is_drawn_where_it_is_an_input_and_moves_nothing_else():
    config = small_config(batch=64)
    asked = replace(config, spec=replace(config.spec, speed_input=True))
    plain, worlds = sample_worlds(config, 2), sample_worlds(asked, 2)
    jax.tree.map(np.testing.assert_array_equal, plain, worlds._replace(speed_command=None))
    races = worlds.speed_command == 1.0
    others = worlds.speed_command[~races]
    assert 0.3 < races.mean() < 0.7 and abs(others.mean() - 0.5) < 0.15
    assert others.min() < 0.2 and 0.8 < others.max() < 1.0


def test_worlds_at_rest_stop_early_and_forget_the_others_remember():
    config = small_config(batch=64, steps=30, rest_share=0.5, stop_from=0.33)
    worlds = sample_worlds(config, 0)
    rests = worlds.remembers == 0
    assert 0 < rests.sum() < 64 and not worlds.vel_w[rests].any()
    assert (worlds.stop[~rests] == 30).all() and worlds.stop[rests].min() >= 10
    assert len(np.unique(worlds.stop[rests])) > 5


RAYS = jnp.asarray(pixel_rays_b(Camera()), jnp.float32)
WORLDS = 40

image = jax.jit(partial(depth_image, range_m=10.0), static_argnames="limits")
nearest = jax.jit(nearest_obstacle, static_argnames="limits")


def flights(family):
    """Return scenes of all levels and poses on the way from gate to gate, looking ahead."""
    rng = np.random.default_rng(11)
    tracks = [make_track(family, i % 10, i) for i in range(WORLDS)]
    pos, yaw = [], []
    for track in tracks:
        center = track.scene.gates.center_w
        i = rng.integers(0, len(center) - 1)
        way = center[i + 1] - center[i]
        pos.append(center[i] + rng.uniform(0.05, 0.95) * way + rng.normal(0, 0.3, 3))
        yaw.append(np.arctan2(way[1], way[0]) + rng.normal(0, 0.4))
    pos = np.maximum(np.array(pos), [-np.inf, -np.inf, 0.3])
    scene = jax.tree.map(jnp.asarray, stack([t.scene for t in tracks], MAX_COUNTS))
    rot = yaw_rotation(np.array(yaw))
    return scene, jnp.asarray(pos, jnp.float32), jnp.asarray(rot, jnp.float32)


@pytest.mark.extended
@pytest.mark.parametrize("family", FAMILIES)
def test_culled_images_and_distances_are_exact_where_they_matter(family):
    """All but a few far pixels, and distances within 1 m, where the loss of an obstacle starts."""
    scene, pos, rot = flights(family)
    whole, culled = (np.array(image(scene, pos, rot, RAYS, limits=n)) for n in (None, SEEN))
    assert np.mean(whole < 9.9) > 0.2
    missing = np.abs(culled - whole) > 1e-3
    assert np.all(culled[missing] > whole[missing]) and not np.any(missing & (whole < 5.0))
    assert missing.mean() < 2e-3
    step = jnp.asarray(np.random.default_rng(3).normal(0, 0.1, (WORLDS, 1, 3)), jnp.float32)
    path = pos[:, None] + jnp.linspace(0, 1, 4)[:, None] * step
    (whole, away), (culled, culled_away) = (
        map(np.array, nearest(scene, path, limits=n)) for n in (None, NEAR)
    )
    near = whole < 1.15
    assert near.mean() > 0.3
    wrong = (np.abs(culled - whole) > 1e-4) | (np.abs(culled_away - away).max(-1) > 1e-3)
    assert wrong[near].mean() < 0.005 and np.abs(culled - whole).max() < 0.5


@pytest.mark.parametrize("accelerator", [False, True], ids=["a thread", "processes"])
def test_every_iteration_comes_once_and_in_order(accelerator, monkeypatch):
    monkeypatch.setattr(sampling.jax, "default_backend", lambda: "gpu" if accelerator else "cpu")
    monkeypatch.setattr(sampling, "usable_cores", lambda: 3)
    with WorldsAhead() as worlds:
        assert list(worlds.worlds(str, 4, 9)) == [(k, str(k)) for k in range(4, 9)]
        # The next phase goes on with other worlds.
        assert list(worlds.worlds(str, 9, 10)) == [(9, "9")]


def test_the_next_worlds_are_sampled_while_the_devices_compute_and_none_beyond_the_end():
    begun, next_one = [], threading.Event()

    def sample(iteration):
        begun.append(iteration)
        if iteration == 1:
            next_one.set()
        return iteration

    with WorldsAhead() as worlds:
        for iteration, _ in worlds.worlds(sample, 0, 2):
            assert iteration or next_one.wait(10.0)
    assert begun == [0, 1]


BATCH = 6
SMALL = small_config(batch=BATCH)
ALL = SensorsConfig(load_sensors("all"))


def sensed(**changes):
    return replace(SMALL, sensors=replace(ALL, **changes))


def seen(config, steps=3):
    """Return a function (worlds, start) of what a drone that moves and turns sees, and both."""
    observer = Observer(config)
    worlds = boxes_worlds(config)
    start = make_dynamics(config).start(worlds.constants, *map(jnp.asarray, worlds[1:4]))
    turn = exp_rot(jnp.array([0.0, 0.05, 0.1]))

    def of(worlds, state):
        def move(episode, step):
            state, keys = episode.state, world_keys(jax.random.fold_in(KEY, step), worlds)
            moved = {"pos_w": state.pos_w + 0.05 * state.vel_w, "rot_w": state.rot_w @ turn}
            state = state._replace(**moved)
            episode = episode._replace(state=state, action_b=state.pos_w)
            return observer.observe(worlds, episode, keys)[::-1]

        return jax.lax.scan(move, observer.start(worlds, state, (1,)), jnp.arange(steps))[1]

    return of, worlds, start


def unrounded(*names):
    """Return sensors of these models, with a stereo camera that does not round disparities."""
    models = {**ALL.seen.models, "stereo": ALL.seen.models["stereo"]._replace(step=0.0)}
    return replace(ALL.seen, models={name: models[name] for name in names or models})


@pytest.mark.extended
@pytest.mark.parametrize(
    "names",
    [("delay", "state_noise", "stereo"), pytest.param((), id="all")],
)
def test_at_magnitude_nothing_the_truth_is_seen(names):
    few = unrounded(*names)
    shown, perfect, state = seen(sensed(seen=few, perfect_share=1.0, magnitude=(1.0, 1.0)))
    noisy = seen(sensed(seen=few, perfect_share=0.0, magnitude=(1.0, 1.0)))[1]
    (without, worlds, _), shown = seen(SMALL), jax.jit(shown)
    one, last = (shown(each, state) for each in (perfect, noisy))
    none = jax.jit(without)(worlds, state)
    np.testing.assert_allclose(one.state, none.state, atol=2e-5)
    np.testing.assert_allclose(one.image, none.image, atol=2e-5)
    assert np.ptp(last.state[-1] - none.state[-1]) > 1e-2
    assert np.ptp(last.image[-1] - none.image[-1]) > 1e-2


@pytest.mark.extended
def test_the_state_carries_a_finite_gradient_and_the_image_none():
    """Along a change of all positions, then one of all attitudes: forwards compiles faster."""
    _, worlds, state = seen(sensed(perfect_share=0.0, magnitude=(2.0, 2.0)))
    of, rng = seen(sensed(seen=unrounded()))[0], np.random.default_rng(2)
    way, turn = rng.normal(size=(BATCH, 3)), rng.normal(size=(BATCH, 3, 3))

    def sums(along):
        moved = {"pos_w": state.pos_w + along[0] * way, "rot_w": state.rot_w + along[1] * turn}
        found = of(worlds, state._replace(**moved))
        return found.state.sum(), found.image.sum()

    of_state, of_image = map(np.asarray, jax.jit(jax.jacfwd(sums))(jnp.zeros(2)))
    assert np.isfinite(of_state).all() and np.abs(of_state).min() > 0.1
    assert not of_image.any()


def test_magnitudes_are_drawn_per_world_and_model_from_the_range():
    sensors = replace(ALL, perfect_share=0.25, magnitude=(0.5, 2.0))
    config = replace(small_config(batch=80), sensors=sensors)
    drawn = sample_worlds(config, 0).sensed
    assert set(drawn.magnitude) == set(ALL.seen.models)
    table = np.stack(list(drawn.magnitude.values()))
    none = (table == 0.0).all(0)
    assert none.mean() == pytest.approx(0.25, abs=0.1)
    assert table[:, ~none].min() >= 0.5 and table[:, ~none].max() <= 2.0
    assert len(np.unique(table[:, ~none])) == table[:, ~none].size
    assert drawn.trial["gate_map"].normal.shape == (80, SENSORS["gate_map"].trial.normal)
    plain, again = (sample_worlds(c, 0) for c in (replace(config, sensors=None), config))
    for field in ("pos_w", "target", "stop", "fov_scale"):
        assert np.array_equal(getattr(plain, field), getattr(again, field)), field
    assert plain.sensed is None


def test_an_old_view_lies_between_two_decisions():
    worlds = boxes_worlds(SMALL)
    state = make_dynamics(SMALL).start(worlds.constants, *map(jnp.asarray, worlds[1:4]))
    now = jax.jit(view_in)(worlds, state, worlds.target)
    now = jax.tree.map(np.asarray, now._replace(depth_m=np.ones((BATCH, 2, 2))))
    before = now._replace(pos_w=now.pos_w - 1.0, gate_w=now.gate_w + 5.0, depth_m=now.depth_m * 2)
    first = before._replace(pos_w=now.pos_w - 3.0, depth_m=now.depth_m * 3)
    age = np.linspace(0.0, 2.0, BATCH)  # 0, 0.4, 0.8, 1.2, 1.6, 2
    old = jax.jit(delayed_view)((now, before, first), age, np.round(age))
    away = np.array(now.pos_w - old.pos_w)[:, 0]
    assert away == pytest.approx([0.0, 0.4, 0.8, 1.4, 2.2, 3.0], abs=1e-5)
    assert np.array_equal(old.gate_w != now.gate_w, np.repeat(age[:, None] > 0.5, 3, 1))
    assert np.array_equal(old.depth_m[:, 0, 0], [1, 1, 2, 2, 3, 3])


def test_the_command_trains_through_a_file_and_a_fine_tuning_is_the_last_phase_at_small_steps(
    tmp_path,
):
    path = tmp_path / "mine.toml"
    path.write_text('name = "mine"\n[depth]\nkind = "stereo"\nnoise = 0.2\n')
    change = ("sensors.magnitude=(0.0,1.5)",)
    run = resolve(Config(recipe="quick", sensors=str(path), set=change))
    assert run.sensors is not None and run.sensors.magnitude == (0.0, 1.5)
    assert run.sensors.seen == sensor_set({"stereo": {"noise": 0.2}}, "mine")
    with pytest.raises(ValueError, match="has no sensor models; suite train: add --sensors"):
        resolve(Config(recipe="quick", set=change))
    run = resolve(Config(sensors="vio", finetune=True, init_from="race"))
    assert run.phases == () and run.spec.rate_hz == 30.0 and run.sensors is not None
    assert (run.optimizer.iterations, run.optimizer.rate) == (525, pytest.approx(1.2e-4))
    assert resolve(Config(finetune=True, init_from="race", iterations=9)).optimizer.iterations == 9
    with pytest.raises(ValueError, match="--finetune needs --init-from"):
        resolve(Config(finetune=True))
