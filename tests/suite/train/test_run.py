"""A run in a folder: the same curve with and without stops, kills, shards and faults."""

import json
import threading
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.formats.checkpoint import load_arrays, read_config
from policies.formats.policy_file import load_policy_checkpoint
from policies.networks import delta_network, network
from suite.common import curve
from suite.common.console import Console
from suite.train import run, shards, training_loop
from suite.train.config import OptimizerConfig, check
from suite.train.recipes import with_quadrotor
from suite.train.rollout import make_rollout
from suite.train.shards import check_processes, curve_numbers, flight_numbers, sample_hidden
from suite.train.update import make_optimizer, start_state
from tests.support.marks import more
from tests.support.tools import BLOCKER, python
from tests.support.training import (
    NOISY,
    SPEC,
    assert_same_run,
    boxes_worlds,
    flown_of,
    fresh_params,
    gradient_of,
    largest_difference,
    shards_of,
    small_config,
    update_of,
)
from tests.support.vehicles import PLAIN, with_effects

make_update = run.make_update


def compiled_update(config, delta=None, begin=0):
    """Return the trainer's update, compiled once for all tests."""
    return update_of(config) if delta is None else make_update(config, delta, begin)


@pytest.fixture(autouse=True, scope="module")
def _small_scenes():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "sample_worlds", boxes_worlds)
        patch.setattr(run, "make_update", compiled_update)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory, _small_scenes):
    """Return the folder of a run that was never stopped."""
    folder = tmp_path_factory.mktemp("whole")
    run.train(NOISY, folder, Console())
    return folder


def test_a_run_leaves_its_policy_its_curve_and_what_it_was(whole):
    assert [row["iteration"] for row in curve.read(whole)] == list(range(6))
    losses = [row["loss"] for row in curve.read(whole)]
    assert np.all(np.isfinite(losses)) and np.ptp(losses) > 0
    assert json.loads((whole / "run.json").read_text())["config"]["episode"]["batch"] == 4
    policy = load_policy_checkpoint(whole / "policy")
    assert policy.spec == NOISY.spec
    assert policy.config["training"]["iteration"] == 6
    fresh = run.start_state(NOISY).params
    assert all(np.any(policy.params[name] != np.array(value)) for name, value in fresh.items())


def test_all_phases_share_an_optimiser_and_a_low_rate_does_not_rise():
    params, low = {"w": jnp.ones(2)}, OptimizerConfig(iterations=9, warmup=0, rate=1e-6)
    states = [make_optimizer(replace(low, clip=clip)).init(params) for clip in (0.0, 1.0)]
    assert jax.tree.structure(states[0]) == jax.tree.structure(states[1])
    update, sizes = jax.jit(make_optimizer(low).update), []
    for _ in range(10):
        change, states[1] = update(params, states[1], params)
        sizes.append(float(jnp.abs(change["w"]).max()))
    assert max(sizes) < 1.02e-6


def test_an_effect_that_acts_on_no_rollout_is_said(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(run, "train_in_folder", lambda *_: None)
    vehicle = with_effects(PLAIN, battery_sag=(0.0, 0.1), gyro_bias=((0.1, 0.0, 0.0),))
    for rate, said in ((0.0, True), (0.01, False)):
        sagging = with_effects(vehicle, battery_sag=(rate, 0.1))
        run.train(with_quadrotor(NOISY, sagging), tmp_path, Console())
        assert ("battery_sag: acts only on logs with a voltage" in capfd.readouterr().err) == said


class Killed(BaseException):
    """Stands for a kill: nothing after it is written."""


@pytest.mark.parametrize(
    ("owner", "name", "error", "saved"),
    [
        (run, "sample_worlds", KeyboardInterrupt, 3),
        (training_loop, "save_arrays", Killed, 2),
        more(curve, "append", Killed, 2),
        more(training_loop, "save_policy", Killed, 2),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_run_that_is_stopped_or_killed_while_saving_resumes_exactly(
    owner, name, error, saved, whole, tmp_path, monkeypatch
):
    real, calls = getattr(owner, name), []

    def dying(*args, **kwargs):
        calls.append(0)
        if len(calls) > saved:
            raise error
        return real(*args, **kwargs)

    with monkeypatch.context() as patch, pytest.raises(error):
        # A run that is stopped saves at its end; one that is killed has what it saved before.
        patch.setattr(training_loop, "SAVE_PERIOD_S", 0.0 if error is Killed else 1e9)
        patch.setattr(owner, name, dying)
        run.train(NOISY, tmp_path, Console())
    assert read_config(tmp_path / "state")["training"]["iteration"] == saved
    load_policy_checkpoint(tmp_path / "policy")
    with (tmp_path / curve.CURVE).open("a") as file:
        file.write('{"iteration": 2, "lo')
    assert run.train(NOISY, tmp_path, Console()).iterations == 6
    assert_same_run(tmp_path, whole)


BARE = f"""{BLOCKER}
blocked.update(("mujoco", "torch", "dm_control", "gymnasium", "trimesh", "onnx"))
import os
from pathlib import Path
import tracks.common.files
from suite.common.console import Console
from suite.train import run, training_loop
from tests.support.training import NOISY, boxes_worlds
run.sample_worlds, training_loop.SAVE_PERIOD_S = boxes_worlds, 0.0
real, renamed = os.replace, []
def replace(source, target):
    if Path(target).name == "state":
        renamed.append(0)
        if len(renamed) == 3:
            os._exit(9)
    real(source, target)
os.replace = replace
run.train(NOISY, Path(sys.argv[1]), Console())
"""


@pytest.mark.extended
def test_a_bare_machine_trains_and_a_real_kill_while_saving_loses_nothing(
    whole, tmp_path, root, monkeypatch
):
    done = python(BARE, tmp_path, cwd=root)
    assert done.returncode == 9, done.stderr
    assert not (tmp_path / "state").exists()
    begun = []
    monkeypatch.setattr(run, "sample_worlds", lambda c, k: begun.append(k) or boxes_worlds(c, k))
    run.train(NOISY, tmp_path, Console())
    assert begun == [3, 4, 5], "it goes on from the state that was put aside"
    assert_same_run(tmp_path, whole)


def forward(config):
    """Stand for `make_gradient`, with the parameters as gradients: a third of it to compile."""
    fly, shift = make_rollout(config), jnp.zeros((6, 2, SPEC.hidden_size))
    return lambda params, worlds, key, delta: (
        params, *fly(params, shift, worlds, key, network.encode, delta)
    )  # fmt: skip


def test_a_policy_is_trained_under_a_delta_action_that_is_no_part_of_its_state(
    whole, tmp_path, monkeypatch
):
    monkeypatch.setattr(shards, "make_gradient", forward)
    delta = delta_network.init(jax.random.key(1))
    delta["output.weight"] += 0.3
    run.train(NOISY, tmp_path, Console(), None, delta)
    corrected, plain = (curve.read(folder)[0]["loss"] for folder in (tmp_path, whole))
    assert abs(corrected - plain) > 1e-3 * abs(plain), "as much as no rounding"
    ours, theirs = (load_arrays(f / "state", kind="training").arrays for f in (tmp_path, whole))
    assert ours.keys() == theirs.keys()
    with pytest.raises(ValueError, match="another --init-from; another --delta"):
        run.train(NOISY, whole, Console(), fresh_params(), delta)


def test_thirty_iterations_on_an_easy_course_reduce_the_loss(tmp_path, monkeypatch):
    """Four worlds without obstacles, the same every time: there is nothing to gain but speed."""
    config = replace(NOISY, optimizer=OptimizerConfig(iterations=30, rate=1e-2, warmup=3))
    worlds = boxes_worlds(small_config(difficulty=(0.0, 0.0), rest_share=1.0))
    boxes = worlds.scene.boxes
    gone = boxes._replace(center_w=boxes.center_w - np.array([0, 0, 1000], np.float32))
    slower = worlds.constants._replace(time_step=4 * worlds.constants.time_step)
    worlds = worlds._replace(scene=worlds.scene._replace(boxes=gone), constants=slower)
    monkeypatch.setattr(run, "sample_worlds", lambda *_: worlds)
    run.train(config, tmp_path, Console(), fresh_params())
    found = curve.read(tmp_path)
    losses = [row["loss"] for row in found]
    assert losses[0] - losses[-1] > 0.2
    assert np.mean(np.diff(losses) < 0) > 0.8
    assert found[-1]["speed"] > 1.1 * found[0]["speed"]


KEY = jax.random.key(3)


def test_shards_divide_the_batch_and_processes_the_shards(monkeypatch):
    with pytest.raises(ValueError, match=r"episode\.batch is 6, allowed are multiples of episode"):
        check(small_config(batch=6, shards=4))
    monkeypatch.setattr(shards.jax, "process_count", lambda: 3)
    with pytest.raises(ValueError, match="shards is 4, allowed with 3 processes are multiples of"):
        check_processes(small_config(batch=8, shards=4))


def test_two_threads_compute_shards_at_once_and_come_to_the_same_bits(monkeypatch):
    """Each thread waits for the other, so that one after the other would never end."""
    both, names = threading.Barrier(2, timeout=60), list[str]()
    update, state, worlds = update_of(NOISY), start_state(NOISY), boxes_worlds(NOISY)
    with monkeypatch.context() as patch:
        patch.setattr(shards.ThreadPoolExecutor, "map", lambda _, *given: map(*given))
        alone = update(state, worlds)
    real = shards.jax.block_until_ready

    def met(found):
        names.append(threading.current_thread().name)
        both.wait()
        return real(found)

    monkeypatch.setattr(shards.jax, "block_until_ready", met)
    jax.tree.map(np.testing.assert_array_equal, update(state, worlds), alone)
    assert len(set(names)) == len(names) == 2


def test_the_first_shards_are_computed_one_after_the_other_so_that_one_thread_compiles(monkeypatch):
    names = []
    note = lambda *given: names.append(threading.current_thread()) or given[0]  # noqa: E731
    monkeypatch.setattr(shards.jax, "jit", lambda _: note)
    compute, state = shards.make_shards(NOISY), start_state(NOISY)
    for _ in range(2):
        compute(state.params, state.hidden, state.iteration, boxes_worlds(NOISY))
    assert [name is threading.main_thread() for name in names] == [True, True, False, False]


def given_to_shards():
    state = start_state(NOISY)
    hidden = jax.random.normal(KEY, state.hidden.shape)
    return state.params, hidden, state.iteration, boxes_worlds(NOISY)


def test_every_parameter_has_a_gradient_within_the_loop_or_through_images():
    found = shards.batch_mean(shards_of(NOISY)(*given_to_shards()))
    sizes = {k: float(np.abs(np.array(g)).max()) for k, g in found.gradient.items()}
    assert min(sizes.values()) > 1e-7, sizes


@pytest.mark.extended
def test_shards_and_images_outside_the_loop_give_the_gradient_of_the_plain_loop(monkeypatch):
    """Sums of float32 in another order: 1e-4 of an array's largest. Noise is a world's own."""
    config, plain = replace(NOISY, episode=replace(NOISY.episode, shards=1)), gradient_of(NOISY)
    given = given_to_shards()
    found = shards.batch_mean(shards_of(NOISY)(*given))
    monkeypatch.setattr(shards, "make_gradient", lambda _: plain)
    monkeypatch.setattr(shards.jax, "device_put", lambda tree, _: tree)
    with monkeypatch.context() as patch:
        patch.setattr(shards.jax, "jit", lambda function: function)
        whole = shards.make_shards(config)
    expected = shards.batch_mean(whole(*given))
    for one, other in zip(found, expected, strict=True):
        assert largest_difference(one, other) < 1e-4


def test_the_curve_and_remembered_states_are_of_steps_that_counted():
    worlds, params = boxes_worlds(NOISY), fresh_params()
    worlds = worlds._replace(stop=np.array([1, 1, 1, 1]))
    loss, records = flown_of(NOISY)(params, worlds, KEY)
    after = np.arange(6)[:, None] > 0
    # What comes later would be a gate and a collision at 100 m/s.
    records = records._replace(
        passed=after & np.ones_like(records.passed),
        speed=np.where(after, 100.0, records.speed),
        clearance=np.where(after, -1.0, records.clearance),
    )
    shard = shards.Shard(params, flight_numbers(loss, records), records.hidden[0])
    numbers = curve_numbers(shard)
    for name in ("speed", "speed_max"):
        assert numbers[name] == pytest.approx(np.mean(records.speed[0]), rel=1e-6)
    assert numbers["collided"] == numbers["gates"] == 0 and "counted" not in numbers
    assert numbers["memory"] == pytest.approx(np.abs(records.hidden).mean())
    assert 0 < numbers["memory"] < 0.5, "a fresh network's is far from saturated"
    worlds = worlds._replace(stop=np.array([6, 6, 6, 1]))
    records = flown_of(NOISY)(params, worlds, KEY)[1]
    before = jnp.full((4, NOISY.spec.hidden_size), 9.0)
    drawn = jax.jit(jax.vmap(lambda keys: sample_hidden(keys, records, before)))
    seen = np.asarray(drawn(jax.random.split(KEY, (80, 4))))
    for world in range(3):
        known = np.asarray(records.hidden[:, world])
        assert all(any(np.array_equal(row, k) for k in known) for row in seen[:, world])
        assert len(np.unique(seen[:, world, 0])) == 6
    last = seen[:, 3]
    kept = (last == 9.0).all(-1)
    assert 0 < kept.sum() < 80
    assert np.array_equal(last[~kept], np.tile(records.hidden[0, 3], ((~kept).sum(), 1)))
