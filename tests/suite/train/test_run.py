"""A run in a folder: the same curve with and without stops, kills and faults."""

import json
import subprocess
import sys
from dataclasses import replace

import jax
import numpy as np
import pytest

from policies.formats.checkpoint import load_arrays, read_config
from policies.formats.policy_file import load_policy_checkpoint
from policies.networks import delta_network
from suite.common import curve
from suite.common.console import Console
from suite.train import run, training_loop
from tests.support.canonical import NOISY, update_of
from tests.support.training import boxes_worlds, fresh_params, small_config

make_update = run.make_update


def compiled_update(config, delta=None, begin=0):
    """Return the trainer's update, compiled once for all tests."""
    return update_of(config) if delta is None else make_update(config, delta, begin)


@pytest.fixture(autouse=True)
def _small_scenes(monkeypatch):
    monkeypatch.setattr(run, "sample_worlds", boxes_worlds)
    monkeypatch.setattr(run, "make_update", compiled_update)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the folder of a run that was never stopped."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "sample_worlds", boxes_worlds)
        patch.setattr(run, "make_update", compiled_update)
        run.train(NOISY, folder, Console())
    return folder


def rows(folder):
    """Return the curve without the machine's speed."""
    found = curve.read(folder)
    assert all(row.pop(key) >= 0 for row in found for key in ("steps_per_s", "seconds", "cold"))
    return found


def assert_same_run(folder, whole):
    ours, theirs = (load_arrays(f / "state", kind="training").arrays for f in (folder, whole))
    assert ours.keys() == theirs.keys()
    for name, value in theirs.items():
        np.testing.assert_array_equal(ours[name], value, err_msg=name)
    assert rows(folder) == rows(whole)
    policies = [load_policy_checkpoint(f / "policy").params for f in (folder, whole)]
    for name, value in policies[1].items():
        np.testing.assert_array_equal(policies[0][name], value)


def stop_at(monkeypatch, iteration, error=KeyboardInterrupt):
    """Let `error` come before iteration - 1 is computed; call the result to let it pass again."""

    def worlds(config, i):
        if i == iteration - 1:
            raise error
        return boxes_worlds(config, i)

    monkeypatch.setattr(run, "sample_worlds", worlds)
    return lambda: monkeypatch.setattr(run, "sample_worlds", boxes_worlds)


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


def test_a_stopped_run_resumes_exactly(whole, tmp_path, monkeypatch):
    go_on = stop_at(monkeypatch, 4)
    with pytest.raises(KeyboardInterrupt):
        run.train(NOISY, tmp_path, Console())
    assert [row["iteration"] for row in curve.read(tmp_path)] == [0, 1, 2]
    assert read_config(tmp_path / "state")["training"]["iteration"] == 3
    go_on()
    assert run.train(NOISY, tmp_path, Console()).iterations == 6
    assert_same_run(tmp_path, whole)


class Killed(BaseException):
    """Stands for a kill: nothing after it is written."""


@pytest.mark.parametrize("dies_in", ["append", "save_policy", "save_arrays"])
def test_a_kill_in_the_middle_of_saving_leaves_a_run_that_resumes(
    dies_in, whole, tmp_path, monkeypatch
):
    monkeypatch.setattr(training_loop, "SAVE_PERIOD_S", 0.0)
    owner = curve if dies_in == "append" else training_loop
    real, calls = getattr(owner, dies_in), []

    def dying(*args, **kwargs):
        calls.append(0)
        if len(calls) > 2:
            raise Killed
        return real(*args, **kwargs)

    monkeypatch.setattr(owner, dies_in, dying)
    with pytest.raises(Killed):
        run.train(NOISY, tmp_path, Console())
    assert read_config(tmp_path / "state")["training"]["iteration"] == 2
    load_policy_checkpoint(tmp_path / "policy")
    with (tmp_path / curve.CURVE).open("a") as file:
        file.write('{"iteration": 2, "lo')
    monkeypatch.setattr(owner, dies_in, real)
    run.train(NOISY, tmp_path, Console())
    assert_same_run(tmp_path, whole)


BARE = """
import os, sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("mujoco", "torch", "dm_control", "gymnasium", "trimesh", "onnx"):
            raise ImportError("blocked: " + name)
sys.meta_path.insert(0, Blocker())
from pathlib import Path
import tracks.common.files
from suite.common.console import Console
from suite.train import run, training_loop
from tests.support.canonical import NOISY, update_of
from tests.support.training import boxes_worlds, small_config
run.sample_worlds, training_loop.SAVE_PERIOD_S = boxes_worlds, 0.0
real, renamed = os.replace, []
def replace(source, target):
    if Path(target).name == "state":
        renamed.append(0)
        if len(renamed) == 3:
            os._exit(9)
    real(source, target)
os.replace = replace
run.train(small_config(physics={"depth_noise": 0.02}), Path(sys.argv[1]), Console())
"""


def test_a_bare_machine_trains_and_a_real_kill_while_saving_loses_nothing(whole, tmp_path, root):
    done = subprocess.run(
        [sys.executable, "-c", BARE, str(tmp_path)], capture_output=True, text=True, cwd=root
    )
    assert done.returncode == 9, done.stderr
    assert not (tmp_path / "state").exists()
    run.train(NOISY, tmp_path, Console())
    assert_same_run(tmp_path, whole)


def test_a_folder_with_another_run_is_refused(whole):
    other = replace(NOISY, episode=replace(NOISY.episode, rest_share=0.5))
    with pytest.raises(ValueError, match=r"episode\.rest_share is 0\.3 there, 0\.5 here"):
        run.train(other, whole, Console())
    with pytest.raises(ValueError, match="another --from; another --delta"):
        delta = delta_network.init(jax.random.key(0))
        run.train(NOISY, whole, Console(), fresh_params(), delta)
    with pytest.raises(ValueError, match="remove the folder"):
        run.train(replace(NOISY, seed=1), whole, Console())


def test_a_delta_action_stays_as_it_is_while_the_policy_is_trained_under_it(whole, tmp_path):
    delta = delta_network.init(jax.random.key(1))
    delta["output.weight"] += 0.3
    before = {name: np.array(value) for name, value in delta.items()}
    run.train(NOISY, tmp_path, Console(), None, delta)
    for name, value in before.items():
        np.testing.assert_array_equal(delta[name], value)
    assert rows(tmp_path)[0]["loss"] != rows(whole)[0]["loss"]
    arrays = load_arrays(tmp_path / "state", kind="training").arrays
    assert arrays.keys() == load_arrays(whole / "state", kind="training").arrays.keys()


def test_thirty_iterations_on_an_easy_course_reduce_the_loss(tmp_path, monkeypatch):
    """Eight worlds without obstacles, the same every time: there is nothing to gain but speed."""
    optimizer = {"iterations": 30, "rate": 1e-2, "warmup": 3}
    config = small_config(8, 24, optimizer=optimizer, difficulty=(0.0, 0.0), rest_share=1.0)
    worlds = boxes_worlds(config)
    boxes = worlds.scene.boxes
    gone = boxes._replace(center_w=boxes.center_w - np.array([0, 0, 1000], np.float32))
    worlds = worlds._replace(scene=worlds.scene._replace(boxes=gone))
    monkeypatch.setattr(run, "sample_worlds", lambda *_: worlds)
    run.train(config, tmp_path, Console(), fresh_params())
    found = curve.read(tmp_path)
    losses = [row["loss"] for row in found]
    assert losses[0] - losses[-1] > 0.04
    assert np.mean(np.diff(losses) < 0) > 0.8
    assert found[-1]["speed"] > 1.1 * found[0]["speed"]
