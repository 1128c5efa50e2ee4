"""Sensor models in training: drawn per world, nothing at magnitude 0, finite gradients."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.sensors import SENSORS
from eval.sensors.sensors_file import load_sensors, sensor_set
from suite.commands.train import Config, resolve
from suite.train.config import SensorsConfig
from suite.train.dynamics.interface import make_dynamics
from suite.train.rollout import delayed_view, make_observer, view_in, world_keys
from suite.train.worlds import sample_worlds
from tests.support.training import KEY, boxes_worlds, small_config
from tracks.geometry.rotation import exp_rot

BATCH = 6
SMALL = small_config(batch=BATCH)
ALL = SensorsConfig(load_sensors("all"))


def sensed(**changes):
    return replace(SMALL, sensors=replace(ALL, **changes))


def seen(config, steps=3):
    """Return a function (worlds, start) of what a drone that moves and turns sees, and both."""
    observer = make_observer(config)
    worlds = boxes_worlds(config)
    start = make_dynamics(config).start(worlds.constants, *map(jnp.asarray, worlds[1:4]))
    target, turn = jnp.asarray(worlds.target), exp_rot(jnp.array([0.0, 0.05, 0.1]))

    def of(worlds, state):
        def move(carry, step):
            state, memory = carry
            keys = world_keys(jax.random.fold_in(KEY, step), worlds)
            moved = {"pos_w": state.pos_w + 0.05 * state.vel_w, "rot_w": state.rot_w @ turn}
            state = state._replace(**moved)
            one, memory = observer.observe(worlds, state, target, state.pos_w, keys, memory)
            return (state, memory), one

        begin = state, observer.start(worlds, state)
        return jax.lax.scan(move, begin, jnp.arange(steps))[1]

    return of, worlds, start


@pytest.fixture(scope="module")
def shown():
    """Return a function (worlds, start) of what is seen, and slopes by the pose of its sums.

    The stereo camera does not round disparities: rounding would have no slope anyway.
    """
    unrounded = ALL.seen.models["stereo"]._replace(step=0.0)
    of = seen(sensed(seen=replace(ALL.seen, models={**ALL.seen.models, "stereo": unrounded})))[0]

    def sums(pose, worlds, state):
        found = of(worlds, state._replace(**pose))
        return (found.state.sum(), found.image.sum()), found

    both = jax.jit(jax.jacrev(sums, has_aux=True))
    pose = ("pos_w", "rot_w")
    return lambda worlds, state: both({k: getattr(state, k) for k in pose}, worlds, state)[::-1]


def test_at_magnitude_nothing_the_truth_is_seen(shown):
    _, perfect, state = seen(sensed(perfect_share=1.0, magnitude=(1.0, 1.0)))
    noisy = seen(sensed(perfect_share=0.0, magnitude=(1.0, 1.0)))[1]
    without, worlds, _ = seen(SMALL)
    one, last = (shown(each, state)[0] for each in (perfect, noisy))
    none = jax.jit(without)(worlds, state)
    np.testing.assert_allclose(one.state, none.state, atol=2e-5)
    np.testing.assert_allclose(one.image, none.image, atol=2e-5)
    assert np.ptp(last.state[-1] - none.state[-1]) > 1e-2
    assert np.ptp(last.image[-1] - none.image[-1]) > 1e-2


def test_the_state_carries_a_finite_gradient_and_the_image_none(shown):
    _, worlds, state = seen(sensed(perfect_share=0.0, magnitude=(2.0, 2.0)))
    of_state, of_image = shown(worlds, state)[1]
    for name in ("pos_w", "rot_w"):
        slope = np.array(of_state[name])
        assert np.isfinite(slope).all() and np.abs(slope).max() > 0.1
        assert not np.array(of_image[name]).any(), name


def test_magnitudes_are_drawn_per_world_and_model_from_the_range():
    sensors = replace(ALL, perfect_share=0.25, magnitude=(0.5, 2.0))
    config = replace(small_config(batch=200), sensors=sensors)
    drawn = sample_worlds(config, 0).sensed
    assert set(drawn.magnitude) == set(ALL.seen.models)
    table = np.stack(list(drawn.magnitude.values()))
    none = (table == 0.0).all(0)
    assert none.mean() == pytest.approx(0.25, abs=0.1)
    assert table[:, ~none].min() >= 0.5 and table[:, ~none].max() <= 2.0
    assert len(np.unique(table[:, ~none])) == table[:, ~none].size
    assert drawn.trial["gate_map"].normal.shape == (200, SENSORS["gate_map"].trial.normal)
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
