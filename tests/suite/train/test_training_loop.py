"""A method that only counts, iterated in a folder: what is measured, resumed and refused."""

import json
import re
import shutil
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.formats.policy_file import load_policy_checkpoint
from suite.common import curve, provenance
from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.common.stages import Estimate
from suite.train import training_loop as module
from suite.train.training_loop import Run, RunPhase, Watch, train_in_folder
from tests.support.training import SPEC, fresh_params, small_config
from tracks.common.files import plain

CONFIG = small_config()


class Count(NamedTuple):
    params: Any
    iteration: jax.Array


FRESH = Count(fresh_params(), jnp.zeros((), int))


def counting(iterations=10, stop=None, bad=None) -> RunPhase:
    """Return a method whose loss is 100 less the iteration; `stop` interrupts, `bad` diverges."""

    def update(state, worlds):
        if worlds == stop:
            raise KeyboardInterrupt
        loss = jnp.nan if worlds == bad else 100.0 - worlds
        return state._replace(iteration=state.iteration + 1), {"loss": jnp.asarray(loss)}

    numbers: Any = lambda i: i  # noqa: E731  (worlds are numbers here)
    return RunPhase(iterations, SPEC, 24, numbers, lambda: update, str)


def train(folder, *phases, config=CONFIG, start=None, seen=None):
    """Train in a folder; the list `seen` gets the parameters of each measurement."""
    origin = {"config": plain(config), "from": start, "delta": None}
    run = Run(config, origin, folder, Estimate(1.0, 1.0))

    def measure(params):
        seen.append(params)
        return {"speed": float(len(seen))}

    watch = None if seen is None else Watch(4, measure)
    return train_in_folder(phases, run, FRESH, Console(), watch)


def measured(folder):
    return [row["iteration"] for row in curve.read(folder, curve.WATCHED)]


def test_the_outcome_is_of_the_last_tenth_and_the_policy_is_measured_on_the_way(tmp_path, capfd):
    seen = []
    outcome = train(tmp_path, counting(20), seen=seen)
    assert outcome.iterations == 20 and outcome.policy == tmp_path / "policy"
    assert outcome.last["loss"] == (100.0 - 18 + 100.0 - 19) / 2
    assert measured(tmp_path) == [0, 4, 8, 12, 16, 20] and len(seen) == 6
    rows = curve.read(tmp_path)
    assert [row["loss"] for row in rows] == [100.0 - i for i in range(20)]
    assert [row["cold"] for row in rows] == [True] + [False] * 19
    assert "nothing is trained" not in capfd.readouterr().err
    train(tmp_path, counting(20), seen=seen)
    assert len(seen) == 6, "a finished run is neither trained nor measured again"
    assert "finished: nothing is trained" in capfd.readouterr().err
    (tmp_path / "policy").rename(tmp_path / "moved")
    train(tmp_path, counting(20))
    (tmp_path / "policy" / "weights.safetensors").write_bytes(b"cut off")
    train(tmp_path, counting(20))
    assert load_policy_checkpoint(tmp_path / "policy").spec == SPEC
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines(keepends=True)
    for kept in (lines[:19], []):  # means over its last rows would not be of the end
        (tmp_path / "metrics.jsonl").write_text("".join(kept))
        with pytest.raises(ValueError, match=r"without the end of its curve, metrics\.jsonl: put"):
            train(tmp_path, counting(20))


def test_a_stopped_run_goes_on_with_its_curve_and_its_measurements(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, counting(stop=6), seen=[])
    assert len(curve.read(tmp_path)) == 6 and measured(tmp_path) == [0, 4]
    assert train(tmp_path, counting(), seen=[]).iterations == 10
    assert [row["iteration"] for row in curve.read(tmp_path)] == list(range(10))
    assert measured(tmp_path) == [0, 4, 8, 10]


def test_rows_of_a_save_that_was_cut_off_are_computed_again(tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(module, "save_arrays", full)
        with pytest.raises(OSError, match="No space"):
            train(tmp_path, counting(3))
    assert len(curve.read(tmp_path)) == 3 and not (tmp_path / "state").exists()
    train(tmp_path, counting(3))  # with more space on the disk
    assert [row["iteration"] for row in curve.read(tmp_path)] == [0, 1, 2]


def test_a_trained_policy_without_its_state_is_not_written_over(tmp_path):
    for trained, stop in ((10, None), (4, 4), (0, 0)):
        folder = tmp_path / str(trained)
        if stop is None:
            train(folder, counting())
        else:
            with pytest.raises(KeyboardInterrupt):
                train(folder, counting(stop=stop))
        shutil.rmtree(folder / "state")
        if trained:
            with pytest.raises(ValueError, match=r"state, from which .* --out .*with --init-from"):
                train(folder, counting())
            assert len(curve.read(folder)) == trained
    assert train(folder, counting()).iterations == 10, "of random weights nothing is lost"


@pytest.mark.parametrize("name", ["config.json", "weights.safetensors"])
def test_a_damaged_state_is_refused_with_what_is_left_to_do(tmp_path, name):
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, counting(stop=6))
    (tmp_path / "state" / name).write_bytes(b"")
    with pytest.raises(ValueError, match=f"state/{name}: .*--init-from .*/policy to train its"):
        train(tmp_path, counting())
    assert len(curve.read(tmp_path)) == 6


def test_a_number_that_is_not_finite_ends_the_run_with_the_last_good_state(tmp_path):
    with pytest.raises(WorkFailed, match="diverged at iteration 3: loss not finite.*another --out"):
        train(tmp_path, counting(bad=3))
    assert len(curve.read(tmp_path)) == 3
    outcome = train(tmp_path, counting())
    assert outcome.iterations == 10 and np.isfinite(outcome.last["loss"])


def test_a_run_on_several_threads_does_not_go_on_with_one_and_goes_on_with_more(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("NPROC", "2")
    train(tmp_path, counting(2))
    monkeypatch.setenv("NPROC", "1")
    with pytest.raises(ValueError, match=r"with 2 threads .* there are 1: .* Set NPROC=2"):
        train(tmp_path, counting(4))
    monkeypatch.setenv("NPROC", "16")
    assert train(tmp_path, counting(4)).iterations == 4


def test_a_run_that_goes_on_says_from_where_and_how_long(tmp_path, capsys):
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, counting(8, stop=6))
    capsys.readouterr()
    train(tmp_path, counting(8))
    assert "from step 6 of 8 on" in capsys.readouterr().err


def test_other_versions_than_at_the_start_give_a_warning_and_a_record(tmp_path, monkeypatch, capfd):
    def with_versions(digest, jax_version, stop=None):
        versions = {**provenance.package_versions(), "jax": jax_version}
        monkeypatch.setattr(provenance, "added_digest", lambda: digest)
        monkeypatch.setattr(provenance, "package_versions", lambda: versions)
        with pytest.raises(KeyboardInterrupt) if stop else nullcontext():
            train(tmp_path, counting(stop=stop))
        record = json.loads((tmp_path / "run.json").read_text())
        found = re.search(r"with other versions \((.*?)\), so", capfd.readouterr().err)
        return found and found[1], record.get("earlier")

    assert with_versions("a", "1", stop=2) == with_versions("a", "1", stop=4) == (None, None)
    assert with_versions("b", "1", stop=6) == (
        "plugins is 'a' there, 'b' here",
        {"plugins": ["a"]},
    )
    both = {"plugins": ["a"], "jax": ["1"]}
    assert with_versions("b", "2", stop=8) == ("jax is '1' there, '2' here", both)
    assert with_versions("b", "2") == (None, both)


def test_a_folder_of_another_run_is_refused_by_what_differs(tmp_path):
    train(tmp_path, counting(2))
    changed = replace(CONFIG, loss=replace(CONFIG.loss, progress=9.0))
    for other, words in (
        ({"config": replace(CONFIG, seed=9)}, r"another run \(seed is 0 there, 9 here\); repeat"),
        ({"config": changed}, r"\(loss\.progress is 1\.2 there, 9\.0 here\)"),
        ({"start": "a digest"}, "another --init-from"),
    ):
        with pytest.raises(ValueError, match=words):
            train(tmp_path, counting(2), **other)
    # The folder is of a version with a further setting.
    path = tmp_path / "state" / "config.json"
    record = json.loads(path.read_text())
    record["training"]["config"]["loss"]["survival"] = 0.0
    path.write_text(json.dumps(record))
    with pytest.raises(ValueError, match=r"\(loss\.survival is 0\.0 there, None here\); repeat"):
        train(tmp_path, counting(4))


@pytest.fixture
def converted(monkeypatch):
    """Return a list of the rates (before, after) of conversions, which double the parameters."""
    rates = []

    def convert(params, before, after):
        rates.append((before.rate_hz / SPEC.rate_hz, after.rate_hz / SPEC.rate_hz))
        return {name: 2 * value for name, value in params.items()}

    monkeypatch.setattr(module.network, "adapt_params", convert)
    return rates


def phases_of(*ends, stop=None):
    """Return phases, each with a rate of its own: 1, 2, ... times the usual one."""
    specs = (replace(SPEC, rate_hz=k * SPEC.rate_hz) for k in range(1, len(ends) + 1))
    pairs = zip(ends, specs, strict=True)
    return [counting(end, stop=stop)._replace(spec=spec) for end, spec in pairs]


def test_phases_follow_each_other_and_a_stop_at_a_boundary_begins_the_next_one_once(
    tmp_path, converted
):
    train(tmp_path / "whole", *phases_of(4, 7))
    whole = load_policy_checkpoint(tmp_path / "whole" / "policy")
    assert converted == [(1, 2)]
    for stop, rate, conversions in ((4, 1, 2), (5, 2, 1)):
        converted.clear()
        folder = tmp_path / str(stop)
        with pytest.raises(KeyboardInterrupt):
            train(folder, *phases_of(4, 7, stop=stop))
        assert load_policy_checkpoint(folder / "policy").spec.rate_hz == rate * SPEC.rate_hz
        assert train(folder, *phases_of(4, 7)).iterations == 7
        assert converted == [(1, 2)] * conversions
        ours = load_policy_checkpoint(folder / "policy")
        for name, value in whole.params.items():
            np.testing.assert_array_equal(ours.params[name], value, err_msg=name)
        assert [row["iteration"] for row in curve.read(folder)] == list(range(7))


def test_a_phase_without_iterations_converts_the_state_for_the_next_one(tmp_path, converted):
    """A recipe of three phases in two iterations: the conversions are from phase to phase."""
    assert train(tmp_path, *phases_of(1, 1, 2)).iterations == 2
    assert converted == [(1, 2), (2, 3)]
