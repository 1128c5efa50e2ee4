"""Benchmarks time both sides on the same work; the page of an accelerator; counted operations."""

import json
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from policies.formats.c.compiler import find_compiler
from policies.formats.torch_twin import torch_twin
from suite import cli
from suite.common.errors import WorkFailed
from suite.diagnose.data.noise import noise_of
from suite.diagnose.evidence import rollouts
from suite.diagnose.evidence.rollouts import RolloutModel, start_estimate
from suite.experiments import gpu
from suite.experiments.bench import diagnose, judge, policy, sysid_baseline, train
from suite.experiments.bench.compare import Comparison, Figure, compare_times, in_turn
from suite.experiments.bench.sysid_baseline import make_task
from suite.experiments.bench.torch_baseline import Baseline, to_torch
from suite.experiments.study.speed import best_time, count_operations, multiplying_rate, peak_memory
from suite.judging.deploy import latency
from suite.train.gradient import make_gradient
from suite.train.recipes import named_recipe
from tests.support.documents import page, reproduce
from tests.support.policy_files import small_checkpoint
from tests.support.training import fresh_params
from tracks.geometry.scene import PARKED_Z


@pytest.mark.slow
def test_both_sides_compute_the_same_loss_and_gradient():
    """Ours leaves far solids out of images, so not to the last digit."""
    base = train.bench_config(2, 4)
    config = replace(base, physics=replace(base.physics, depth_noise=0.0))
    worlds, params = train.bench_worlds(config), fresh_params(config.spec)
    kinds = (worlds.scene.boxes, *worlds.scene[2:5])
    assert sum(part.center_w.shape[1] for part in kinds) == 64 == sum(train.SOLIDS)
    assert all(np.all(part.center_w[..., 2] > PARKED_Z / 2) for part in kinds)
    gradient, loss, _ = jax.jit(make_gradient(config))(params, worlds, jax.random.key(0), None)
    baseline = Baseline(config, {name: np.asarray(value) for name, value in params.items()})
    theirs = baseline.loss(to_torch(worlds))
    theirs.backward()
    assert float(loss) == pytest.approx(float(theirs.detach()), rel=1e-3, abs=1e-4)
    ours = torch_twin({name: np.asarray(value) for name, value in gradient.items()}, config.spec)
    expected = dict(ours.named_parameters())
    for name, value in baseline.network.named_parameters():
        size = float(expected[name].abs().max())
        assert value.grad is not None and size > 0
        assert float((value.grad - expected[name]).abs().max()) < 0.01 * size, name


@pytest.mark.extended
def test_both_sides_have_the_same_residuals():
    task = make_task(20_000, 2.5)
    model = RolloutModel(task.nominal, rotor_input=True, voltage=False, integrator="euler")
    begin = start_estimate(model, task.windows)
    # Without slopes, which take most of the time to compile.
    simulate = jax.jit(rollouts.compiled(task.space.layout, True, False, "euler")[0])
    with jax.enable_x64(True):
        residual = -np.asarray(simulate(model.given, *begin, task.windows)[0])
    noise = noise_of(residual, task.windows)
    problem = sysid_baseline.prepare(task, noise)
    theirs = np.array(problem.residual(task.array("start"), problem.params)[0])
    theirs = theirs.reshape(len(task.windows.flight), -1, 12)
    ours = -residual[:, 1:, :12] / noise[:12]
    # The first tenth of a second: then 5 mm of the centre of mass have not turned much over, and
    # attitude errors as rotation vector and as twice a quaternion's part are the same.
    near = np.asarray(task.windows.row_s)[:, 1:] < 0.1
    seen = np.asarray(task.windows.valid)[:, 1:, :12] & near[..., None]
    assert seen.any(axis=(0, 1)).all()
    np.testing.assert_allclose(theirs[seen], ours[seen], rtol=2e-3, atol=2e-2)


@pytest.mark.extended
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler: cc, or what CC names")
def test_every_engine_is_timed_and_the_ratio_is_of_the_times(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = str(small_checkpoint(tmp_path))
    monkeypatch.setattr(latency, "time_in_turn", partial(latency.time_in_turn, rounds=1))
    assert cli.main(["bench", "policy", "--policy", folder, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["details"]["policy"] == Path(folder).name
    ours, baseline = answer["ours"]["value"], answer["baseline"]["value"]
    assert answer["ratio"] == pytest.approx(baseline / ours)
    rows = {name: row for name, row in answer["details"].items() if isinstance(row, dict)}
    assert set(rows) >= {"C float32", "C int8", "ONNX Runtime", "torch"}
    for row in rows.values():
        assert 0 < row["median_us"] <= row["p99_us"] <= row["max_us"]
    assert rows["C int8"]["weight_bytes"] < 0.4 * rows["C float32"]["weight_bytes"]


def test_bench_times_both_sides_in_turn():
    calls = []
    ticks = count()
    sides = {
        "ours": lambda: calls.append("ours"),
        "baseline": lambda: (calls.append("baseline"), next(ticks), next(ticks)),
    }
    taken = in_turn(sides, 3, clock=lambda: next(ticks))
    assert calls == ["ours", "baseline"] * 4
    assert taken == {"ours": [1] * 3, "baseline": [3] * 3}
    assert compare_times("a", taken, 6.0, "steps/s", {}).baseline == Figure(2.0, "steps/s")
    assert in_turn(sides, 3, most_s=0.0).keys() == {"ours", "baseline"} and len(calls) == 12
    figures = Figure(6.0, "steps/s"), Figure(2.0, "steps/s")
    assert Comparison("a", *figures).ratio == pytest.approx(3.0)


def test_the_speed_of_a_training_is_in_decisions_of_all_drones_in_a_second(monkeypatch):
    for name in ("_ours", "_baseline", "bench_worlds"):
        monkeypatch.setattr(train, name, lambda *_: None)
    monkeypatch.setattr(train, "in_turn", lambda sides, *_, **__: {key: [3.0] for key in sides})
    result = train._compare(6, 5, 1)
    assert result.ours == Figure(10.0, "decisions/s") and "10 decisions/s" in result.warnings[0]


def test_without_a_compiler_or_packages_it_says_what_to_install(monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(WorkFailed, match="no C compiler"):
        policy.run()
    monkeypatch.setattr(sysid_baseline, "is_installed", lambda: False)
    with pytest.raises(WorkFailed, match=r"pip install 'diffracing-suite\[sysid\]'"):
        diagnose.run()


@pytest.mark.extended
def test_both_sides_fly_the_same_trials_to_the_same_end(tmp_path, monkeypatch, capsys):
    folder, run = str(small_checkpoint(tmp_path)), judge.run
    monkeypatch.setattr(judge, "run", lambda: run(folder, trials=3, time_limit_s=0.2))
    assert cli.main(["bench", "judge", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["ours"]["value"] > 0 and answer["baseline"]["value"] > 0
    assert answer["ratio"] == answer["ours"]["value"] / answer["baseline"]["value"]
    assert answer["details"]["trials_that_end_alike"] == 3
    assert answer["details"]["images_a_trial"] > 1


SMALL = (
    *("--worlds", "2", "3", "--train-worlds", "2", "--seconds", "0.1", "--trials", "3"),
    *("--paired-trials", "3", "--timed-s", "0.2", "--matrix", "32"),
)


def short(name):
    """Return a recipe whose rollouts are six decisions long."""
    recipe = named_recipe(name)
    return replace(
        recipe,
        episode=replace(recipe.episode, steps=6),
        phases=(replace(recipe.phases[0], share=1.0, set=()),),
    )


@pytest.mark.slow
def test_the_page_has_speeds_a_training_and_the_cpus_outcomes(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu, "named_recipe", short)
    assert reproduce(tmp_path, "gpu", *SMALL) == 0
    text, numbers = page(tmp_path, "gpu")
    assert {(row["model"], row["worlds"]) for row in numbers["trainer"]} == {
        (model, worlds) for model in ("quadrotor", "point") for worlds in (2, 3)
    }
    assert all(row["seconds"] > 0 and row["operations"] > 1e6 for row in numbers["trainer"])
    assert [row["worlds"] for row in numbers["judge"]] == [2, 3]
    # On a CPU both sides are the same program.
    assert numbers["paired"]["mjx on the CPU"]["same_ending"] == 3
    training = numbers["training"]
    assert len(training["curve"]) == training["iterations"] >= 1
    assert "## A short training" in text


def test_worlds_that_are_repeated_have_numbers_of_their_own(monkeypatch):
    monkeypatch.setattr(gpu, "SAMPLED", 2)
    phase = gpu.last_phase(gpu.Config(), "quadrotor", 5)
    worlds = gpu.repeated_worlds(phase)
    assert worlds.number.tolist() == [0, 1, 2, 3, 4]
    assert (worlds.pos_w[0] == worlds.pos_w[2]).all() and (worlds.pos_w[0] != worlds.pos_w[1]).any()


A, B = jnp.ones((3, 4)), jnp.ones((4, 5))
IMAGES, KERNELS, SQUARE = jnp.ones((2, 1, 6, 6)), jnp.ones((3, 1, 3, 3)), jnp.ones((4, 4))
LOOPED = 6


def looped(a):
    return jax.lax.scan(lambda c, _: (c @ c, None), a, None, length=LOOPED)[0]


def product_or_not(a):
    return jax.lax.cond(a[0, 0] > 0, lambda a: a @ a, lambda a: a, a)


@pytest.mark.parametrize(
    ("function", "given", "operations"),
    [
        (lambda a, b: a @ b, (A, B), 2 * 3 * 4 * 5),
        (lambda a: a + 1.0, (A,), 12),
        (jax.jit(looped), (SQUARE,), LOOPED * 2 * 4**3),
        # 2 images of 1 x 6 x 6, 3 kernels of 1 x 3 x 3, at 4 x 4 places each.
        (lambda x, k: jax.lax.conv(x, k, (1, 1), "VALID"), (IMAGES, KERNELS), 2 * 2 * 3 * 16 * 9),
        (product_or_not, (SQUARE,), pytest.approx(2 * 4**3, abs=4)),
    ],
)
def test_operations_are_counted_by_hand(function, given, operations):
    assert count_operations(function, *given) == operations


def test_a_time_is_of_the_fastest_call_and_memory_is_of_this_process(monkeypatch):
    times = {"": [3.0, 1.0, 5.0]}
    monkeypatch.setattr("suite.experiments.study.speed.in_turn", lambda *_, **__: times)
    assert best_time(lambda: A) == 1.0
    monkeypatch.undo()
    assert peak_memory() > 1e7 and 1e6 < multiplying_rate(64) < 1e15
