"""What a loop's options come to, its stages, and what is refused before anything is written."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from eval.worlds import rotorpy as rotorpy_world
from policies import shipped
from suite import cli
from suite.common.errors import WorkFailed
from suite.common.stages import is_done
from suite.common.usage import renamed
from suite.loop import delta_action, hidden_effect, work
from suite.loop.config import (
    DeltaLoopConfig,
    HiddenLoopConfig,
    default_recipe,
    loop_by_content,
    resolve,
)
from suite.loop.variants import DeltaModel, Variant
from suite.loop.work import LoopRun, Quiet, plan
from tests.support.engines import STAND_IN
from tests.support.vehicles import with_effects

EXAMPLE = "examples/hidden.toml"


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--recipe", "quik"], "Did you mean 'quick'?"),
        (["--policy", "nobody.onnx"], "give a checkpoint's folder"),
        (["--track", "my.toml"], "would be the same; give families"),
        (["--track", "zigzg"], "Did you mean 'zigzag'?"),
        (["--difficulty", "10"], "level 10 is not 0 to 9"),
        (["--vehicle", "referense"], "Did you mean 'reference'?"),
        (["--trials", "0"], "--trials is 0"),
        (["--trials", "100001"], "--trials is 100001, allowed is 1 to 100000"),
        (["--flights", "1", "--track", "zigzag", "--difficulty", "0"], "--flights is 1"),
        (["--iterations", "0"], "--iterations is 0"),
        (["--finetune-iterations", "0"], "--finetune-iterations is 0"),
        (["--fit-iterations", "0"], "--fit-iterations is 0"),
        (["--set", "loss.progres=1"], "Did you mean 'progress'?"),
        (["--no-delta"], "without --hidden-vehicle the loop needs the Delta Action Model"),
        (["--set", "seed=5"], "this command sets seed; give --seed"),
        (["--set", "optimizer.iterations=5"], "give --iterations"),
        (
            ["--policy", "race-paper", "--set", "optimizer.iterations=5"],
            "give --finetune-iterations",
        ),
        (
            ["--policy", "race-paper", "--set", "spec.rate_hz=30"],
            "sets spec.rate_hz; a policy keeps",
        ),
        (
            ["--policy", "race-paper", "--iterations", "5"],
            "--iterations is 5, but with --policy, --hidden-vehicle or",
        ),
        (["--hidden-vehicle", "reference"], "nothing is hidden"),
        (["--simulator", "mjx"], "nothing is hidden"),
        (["--hidden-vehicle", "nowhere.toml"], "nowhere.toml: no such file"),
        (["--simulator", "reference"], "records no flights"),
        (["--hidden-vehicle", EXAMPLE, "--iterations", "5"], "--finetune-iterations"),
        (
            ["--hidden-vehicle", EXAMPLE, "--no-delta", "--fit-iterations", "5"],
            "--fit-iterations is 5, but",
        ),
        (["--hidden-vehicle", EXAMPLE, "--policy", "nobody.onnx"], "give a checkpoint's folder"),
        (["--hidden-vehicle", EXAMPLE, "--track", "my.toml"], "would be the same; give families"),
        (["--hidden-vehicle", EXAMPLE, "--flights", "0"], "--flights is 0"),
        (["--hidden-vehicle", EXAMPLE, "--set", "quadrotor.mas_std=0"], "Did you mean 'mass_std'"),
    ],
)
def test_what_cannot_be_used_is_said_before_anything_is_written(
    args, words, tmp_path, monkeypatch, root, capsys
):
    monkeypatch.chdir(root)
    out = tmp_path / "out"
    assert cli.main(["loop", *args, "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert words in said and len(said.strip().splitlines()) == 1
    assert not out.exists()


def test_a_copy_under_another_name_hides_nothing(tmp_path, root):
    copy = tmp_path / "copy.toml"
    text = (root / "eval" / "vehicles" / "racer5.toml").read_text(encoding="utf-8")
    copy.write_text(text.replace('name = "racer5"', 'name = "another"'), encoding="utf-8")
    assert load_vehicle(copy) != load_vehicle("racer5")
    with pytest.raises(ValueError, match="nothing is hidden"):
        resolve(recipe="quick", vehicle="racer5", hidden_vehicle=str(copy))


def test_a_load_on_a_line_may_be_hidden_but_not_known(tmp_path, monkeypatch, root):
    """No stretch of a flight tells the diagnosis how it swings."""
    monkeypatch.chdir(root)
    loaded = str(tmp_path / "loaded.toml")
    save_vehicle(with_effects(slung_load=(0.05, 0.5)), loaded)
    assert (
        resolve(recipe="quick", vehicle="reference", hidden_vehicle=loaded).true_vehicle == loaded
    )
    with pytest.raises(ValueError, match="effects.slung_load has a motion of its own"):
        resolve(recipe="quick", vehicle=loaded, hidden_vehicle="reference")


def test_sizes_are_the_recipes_and_options_go_first(root, monkeypatch):
    monkeypatch.chdir(root)
    loop = resolve(recipe="quick", seed=3, flights=4)
    assert isinstance(loop, DeltaLoopConfig)
    assert (loop.trials, loop.flights, loop.fit.iterations) == (20, 4, 500)
    assert loop.tuning.optimizer.iterations == round(0.25 * loop.training.optimizer.iterations)
    assert loop.tuning.optimizer.rate < loop.training.optimizer.rate
    assert loop.tuning.seed != loop.training.seed and loop.true_simulator == "mujoco"
    assert (loop.recorded_from, loop.cells, loop.true_vehicle) == (100_003, 6, "reference")
    hidden = resolve(recipe="race", hidden_vehicle=EXAMPLE)
    assert isinstance(hidden, HiddenLoopConfig)
    assert (hidden.trials, hidden.flights, hidden.fit.iterations) == (25, 3, 200)
    assert hidden.tuning.optimizer.iterations == 60 and hidden.tuning.quadrotor is not None
    assert hidden.true_vehicle == EXAMPLE and hidden.policy == shipped.DEFAULT
    assert set(hidden.digests) == {"vehicle", "hidden_vehicle", "sensors", "policy"}


@pytest.mark.parametrize(
    ("policy", "recipe"),
    [("race-paper", "race-paper"), ("race", "race"), ("race-small", "race-small"), (None, "race")],
)
def test_a_policy_is_fine_tuned_by_its_own_recipe(policy, recipe, root, monkeypatch):
    monkeypatch.chdir(root)
    assert resolve(policy=policy) == resolve(policy=policy, recipe=recipe)
    hidden = default_recipe(policy or shipped.DEFAULT)
    assert resolve(policy=policy, hidden_vehicle=EXAMPLE) == resolve(
        policy=policy, hidden_vehicle=EXAMPLE, recipe=hidden
    )


def test_settings_are_of_the_fine_tuning_where_a_policy_is_given():
    """Else of the recipe, which the fine-tuning follows at its share of the rate."""
    changes = ("optimizer.rate=1e-4", "episode.rest_share=0.2")
    given = resolve(policy="race-paper", changes=changes).tuning
    assert (given.optimizer.rate, given.episode.rest_share) == (1e-4, 0.2)
    trained = resolve(recipe="quick", changes=changes).tuning
    assert (trained.optimizer.rate, trained.episode.rest_share) == (pytest.approx(3e-5), 0.2)


def test_settings_are_checked_at_the_rate_that_is_fine_tuned():
    """A policy of 30 Hz has 180 steps where the recipe has 90, which 4 does not divide."""
    changes = ("episode.image_stride=4",)
    found = resolve(policy="race", recipe="race-paper", changes=changes)
    assert found.tuning.episode.steps == 180
    with pytest.raises(ValueError, match=r"divisors of episode.steps \(90\)"):
        resolve(recipe="race-paper", changes=changes)


def test_where_files_lie_makes_no_other_loop(root, monkeypatch, tmp_path):
    monkeypatch.chdir(root)
    moved = tmp_path / "hidden.toml"
    moved.write_bytes((root / EXAMPLE).read_bytes())
    here, there = (resolve(recipe="quick", hidden_vehicle=str(path)) for path in (EXAMPLE, moved))
    assert here != there and loop_by_content(here) == loop_by_content(there)
    other = tmp_path / "other" / "hidden.toml"
    save_vehicle(with_effects(com_offset=((0.005, 0.0, 0.0),)), other)
    assert loop_by_content(resolve(recipe="quick", hidden_vehicle=str(other))) != loop_by_content(
        here
    )


def test_a_folder_called_like_something_shipped_makes_no_other_loop(tmp_path, monkeypatch):
    """It is not what is loaded, and may come between an interruption and the same command again."""
    monkeypatch.chdir(tmp_path)

    def asked():
        return loop_by_content(
            resolve(recipe="quick", policy="race-paper", hidden_vehicle="racer5")
        )

    begun = asked()
    for name in ("race-paper", "racer5", "reference"):
        (tmp_path / name).mkdir()
    assert asked() == begun
    for name in ("race-paper", "racer5"):
        (tmp_path / name).rmdir()
    shutil.copytree(shipped.folder("race-paper"), tmp_path / "mine")
    save_vehicle(load_vehicle("racer5"), tmp_path / "racer5")
    own = loop_by_content(resolve(recipe="quick", policy="mine", hidden_vehicle="racer5"))
    assert isinstance(own, HiddenLoopConfig) and own.digests == begun.digests
    assert (own.policy, own.hidden_vehicle, own.vehicle) == ("a file", "a file", "reference")


@pytest.fixture
def rotorpy(monkeypatch):
    monkeypatch.setattr(rotorpy_world, "rotorpy", lambda: STAND_IN)


def test_another_simulator_hides_what_it_does_otherwise(rotorpy):
    config = resolve(recipe="quick", simulator="rotorpy")
    assert isinstance(config, HiddenLoopConfig)
    assert (config.true_vehicle, config.true_simulator) == ("reference", "rotorpy")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (["--world", "mine.toml"], ["--hidden-vehicle", "mine.toml"]),
        (["--world=rotorpy"], ["--simulator", "rotorpy"]),
        (
            ["--seed", "1", "--world", "rotorpy:mine.toml"],
            ["--seed", "1", "--simulator", "rotorpy", "--hidden-vehicle", "mine.toml"],
        ),
    ],
)
def test_the_old_option_is_taken_with_a_note(old, new):
    args, (note,) = renamed("loop", old)
    assert args == new and "--world is now" in note and "0.2" in note


LOOPS = (delta_action.LOOP, hidden_effect.LOOP)


@pytest.mark.parametrize("loop", LOOPS, ids=("delta", "hidden"))
def test_a_declaration_names_what_it_has(loop):
    names = [variant.name for variant in loop.variants]
    assert len(set(names)) == len(names) and "before" in names
    folders = {model.folder for model in loop.models}
    assert {variant.delta for variant in loop.variants if variant.delta} == folders or loop.hidden
    assert {variant.delta for variant in loop.variants} - {None} <= folders
    assert {one.variant for one in loop.shown} <= set(names) and len(loop.shown) == 2
    if not loop.hidden:
        assert not any(one.diagnosed or one.simulated for one in loop.variants)
    # A model is of the vehicle that is flown where it corrects.
    diagnosed = {model.folder: model.diagnosed for model in loop.models}
    for variant in loop.variants:
        assert variant.delta is None or variant.diagnosed == diagnosed[variant.delta]


def test_another_variant_is_another_two_stages():
    longer = Variant("longer", "judging another", "for longer", delta="other")
    loop = replace(
        delta_action.LOOP,
        variants=(*delta_action.LOOP.variants, longer),
        models=(*delta_action.LOOP.models, DeltaModel("other", "fitting another")),
    )
    run = LoopRun(loop, resolve(recipe="quick"), Path("out"), Quiet())
    names = [stage.name for stage in plan(run)]
    assert names.index("other") < names.index("tuned-longer") < names.index("eval-longer")
    assert len(names) == 9 + 3


def test_the_first_policy_is_trained_or_taken():
    for policy, first in ((None, "train"), ("race-paper", "given")):
        config = resolve(recipe="quick", policy=policy)
        run = LoopRun(delta_action.LOOP, config, Path("out"), Quiet())
        stages = plan(run)
        assert stages[0].name == first and len(stages) == 9
        assert run.policy(run.loop.variants[0]) == Path("out") / first / "policy"
        assert all(stage.estimate.seconds > 0 for stage in stages if stage.name != "given")
    assert run.policy(run.loop.variants[2]) == Path("out/tuned-with/policy")


def test_flights_that_cannot_be_fitted_end_the_loop_with_advice(tmp_path, monkeypatch):
    def none(*args):
        raise ValueError("no window of 1.0 s in 3 flights")

    monkeypatch.setattr(work, "fit_delta", none)
    config = resolve(recipe="quick", trials=3)
    run = LoopRun(delta_action.LOOP, config, tmp_path, Quiet())
    stage = next(stage for stage in plan(run) if stage.name == "delta")
    with pytest.raises(WorkFailed, match="no window.*--iterations"):
        stage.work(tmp_path / "delta")
    assert not is_done(tmp_path / "delta")
