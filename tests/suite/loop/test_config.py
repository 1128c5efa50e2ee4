"""What a loop's options come to, its stages, and what is refused before anything is written."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from policies import shipped
from suite.common.errors import WorkFailed
from suite.common.stages import is_done
from suite.common.usage import renamed
from suite.loop import delta_action, hidden_effect, work
from suite.loop.config import loop_by_content, resolve
from suite.loop.variants import DeltaModel, Variant
from suite.loop.work import LoopRun, Quiet, plan
from tests.support import commands
from tests.support.vehicles import with_effects

EXAMPLE = "examples/hidden.toml"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("--policy nobody.onnx", "give a checkpoint's folder"),
        ("--track my.toml", "would be the same; give families"),
        ("--trials 0", "--trials is 0"),
        ("--flights 1 --track zigzag --difficulty 0", "--flights is 1"),
        ("--no-delta", "without --hidden-vehicle the loop needs the Delta Action Model"),
        ("--set optimizer.iterations=5", "give --iterations"),
        ("--policy race-paper --set optimizer.iterations=5", "give --finetune-iterations"),
        ("--policy race-paper --set spec.rate_hz=30", "sets spec.rate_hz; a policy keeps"),
        ("--policy race-paper --set phases.1.loss.progress=1", "this run has no phases"),
        ("--hidden-vehicle {0} --set quadrotor.vehicle.mass=0.9", "mass; give --vehicle"),
        ("--policy race-paper --iterations 5", "--iterations is 5, but with --policy, --hidden"),
        ("--hidden-vehicle reference", "nothing is hidden"),
        ("--simulator mjx", "nothing is hidden"),
        ("--simulator reference", "records no flights"),
        ("--hidden-vehicle {0} --no-delta --fit-iterations 5", "--fit-iterations is 5, but"),
        ("--hidden-vehicle {0} --set quadrotor.mas_std=0", "Did you mean 'mass_std'"),
    ],
)
def test_what_cannot_be_used_is_said_before_anything_is_written(
    line, words, tmp_path, root, capsys
):
    asked = f"loop {line.format(root / EXAMPLE)} --out"
    assert words in commands.refused(capsys, asked, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_a_copy_under_another_name_hides_nothing_and_a_load_on_a_line_may_be_hidden_only(
    tmp_path, root
):
    copy = tmp_path / "copy.toml"
    text = (root / "eval" / "vehicles" / "racer5.toml").read_text(encoding="utf-8")
    copy.write_text(text.replace('name = "racer5"', 'name = "another"'), encoding="utf-8")
    assert load_vehicle(copy) != load_vehicle("racer5")
    with pytest.raises(ValueError, match="nothing is hidden"):
        resolve(recipe="quick", vehicle="racer5", hidden_vehicle=str(copy))
    # No stretch of a flight tells the diagnosis how it swings.
    loaded = str(tmp_path / "loaded.toml")
    save_vehicle(with_effects(slung_load=(0.05, 0.5)), loaded)
    assert hidden_loop(hidden=loaded).true_vehicle == loaded
    with pytest.raises(ValueError, match="effects.slung_load has a motion of its own"):
        resolve(recipe="quick", vehicle=loaded, hidden_vehicle="reference")


def test_sizes_are_the_recipes_options_go_first_and_a_policy_has_its_own_recipe(root, monkeypatch):
    monkeypatch.chdir(root)
    loop = resolve(recipe="quick", seed=3, flights=4)
    assert (loop.trials, loop.flights, loop.fit.iterations) == (20, 4, 500)
    assert loop.tuning.optimizer.iterations == round(0.25 * loop.training.optimizer.iterations)
    assert loop.tuning.optimizer.rate < loop.training.optimizer.rate
    assert loop.tuning.seed != loop.training.seed and loop.simulator == "mujoco"
    assert (loop.recorded_from, loop.cells, loop.true_vehicle) == (100_003, 6, "reference")
    assert loop.hidden_vehicle is None
    hidden = resolve(recipe="race", hidden_vehicle=EXAMPLE)
    assert (hidden.trials, hidden.flights, hidden.fit.iterations) == (25, 3, 200)
    assert hidden.tuning.optimizer.iterations == 60 and hidden.tuning.quadrotor is not None
    assert hidden.true_vehicle == EXAMPLE and hidden.policy == shipped.DEFAULT
    assert set(hidden.digests) == {"vehicle", "hidden_vehicle", "sensors", "policy"}
    for policy in ("race-paper", "race-small", None):
        assert resolve(policy=policy) == resolve(policy=policy, recipe=policy or "race")
        hidden, own = {"policy": policy, "hidden_vehicle": EXAMPLE}, policy or shipped.DEFAULT
        assert resolve(**hidden) == resolve(**hidden, recipe=own)


def test_settings_are_of_the_fine_tuning_and_its_rate_where_a_policy_is_given():
    """Else of the recipe, which the fine-tuning follows at its share of the learning rate."""
    changes = ("optimizer.rate=1e-4", "episode.rest_share=0.2")
    given = resolve(policy="race-paper", changes=changes).tuning
    assert (given.optimizer.rate, given.episode.rest_share) == (1e-4, 0.2)
    trained = resolve(recipe="quick", changes=changes).tuning
    assert (trained.optimizer.rate, trained.episode.rest_share) == (pytest.approx(3e-5), 0.2)
    # A policy of 30 Hz has 180 steps where the recipe has 90, which 4 does not divide.
    changes = ("episode.image_stride=4",)
    found = resolve(policy="race", recipe="race-paper", changes=changes)
    assert found.tuning.episode.steps == 180
    with pytest.raises(ValueError, match=r"divisors of episode.steps \(90\)"):
        resolve(recipe="race-paper", changes=changes)


def hidden_loop(policy="race-paper", hidden="racer5"):
    return resolve(recipe="quick", policy=policy, hidden_vehicle=str(hidden))


def test_where_files_lie_makes_no_other_loop(root, tmp_path):
    here, there, other = root / EXAMPLE, tmp_path / "hidden.toml", tmp_path / "other.toml"
    there.write_bytes(here.read_bytes())
    save_vehicle(with_effects(com_offset=((0.005, 0.0, 0.0),)), other)
    loops = [hidden_loop(hidden=path) for path in (here, there, other)]
    assert loops[0] != loops[1]
    contents = list(map(loop_by_content, loops))
    assert contents[0] == contents[1] != contents[2]


def test_a_folder_called_like_something_shipped_makes_no_other_loop(tmp_path, monkeypatch):
    """It is not what is loaded, and may come between an interruption and the same command again."""
    monkeypatch.chdir(tmp_path)
    begun = loop_by_content(hidden_loop())
    for name in ("race-paper", "racer5", "reference"):
        (tmp_path / name).mkdir()
    assert loop_by_content(hidden_loop()) == begun
    (tmp_path / "racer5").rmdir()
    shutil.copytree(shipped.folder("race-paper"), tmp_path / "mine")
    save_vehicle(load_vehicle("racer5"), tmp_path / "racer5")
    own = loop_by_content(hidden_loop(policy="mine"))
    assert own.digests == begun.digests
    assert (own.policy, own.hidden_vehicle, own.vehicle) == ("a file", "a file", "reference")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("--world mine.toml", "--hidden-vehicle mine.toml"),
        ("--world=rotorpy", "--simulator rotorpy"),
        ("--world rotorpy:mine.toml", "--simulator rotorpy --hidden-vehicle mine.toml"),
    ],
)
def test_the_old_option_is_taken_with_a_note(old, new):
    args, (note,) = renamed("loop", ["--seed", "1", *old.split()])
    assert args == ["--seed", "1", *new.split()] and "--world is now" in note and "0.2" in note


LOOPS = (delta_action.LOOP, hidden_effect.LOOP, hidden_effect.WITHOUT_DELTA)


@pytest.mark.parametrize("loop", LOOPS, ids=("delta", "hidden", "hidden without delta"))
def test_a_declaration_names_what_it_has(loop):
    names = [variant.name for variant in loop.variants]
    assert len(set(names)) == len(names) and "before" in names
    assert {one.variant for one in loop.shown} <= set(names) and len(loop.shown) == 2
    # A model is of the vehicle that is flown where it corrects.
    diagnosed = {model.folder: model.diagnosed for model in loop.models}
    corrected = {one.delta: one.diagnosed for one in loop.variants if one.delta}
    assert corrected == diagnosed
    if not loop.hidden:
        assert not any(one.diagnosed or one.simulated for one in loop.variants)


def test_a_variant_is_two_stages_and_the_first_policy_is_trained_or_taken():
    for policy, first in ((None, "train"), ("race-paper", "given")):
        config = resolve(recipe="quick", policy=policy)
        run = LoopRun(delta_action.LOOP, config, Path("out"), Quiet())
        stages = plan(run)
        assert stages[0].name == first and len(stages) == 9
        assert run.policy(run.loop.variants[0]) == Path("out") / first / "policy"
        assert all(stage.estimate.seconds > 0 for stage in stages if stage.name != "given")
    assert run.policy(run.loop.variants[2]) == Path("out/tuned-with/policy")
    longer = Variant("longer", "judging another", "for longer", delta="other")
    variants, models = (*run.loop.variants, longer), (*run.loop.models, DeltaModel("other", ""))
    more = plan(replace(run, loop=replace(run.loop, variants=variants, models=models)))
    names = [stage.name for stage in more]
    assert names.index("other") < names.index("tuned-longer") < names.index("eval-longer")
    assert len(names) == 9 + 3


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
