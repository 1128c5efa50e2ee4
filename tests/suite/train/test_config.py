"""Recipes and settings by name, phases of a run, and what no training can be made with."""

import math
import re
from dataclasses import replace

import pytest

from suite.commands.list import settings_to_change
from suite.commands.train import Config, resolve
from suite.common.console import Console
from suite.train import losses
from suite.train.config import Phase, TrainConfig, check
from suite.train.overrides import (
    FROM_FILES,
    at_rate,
    check_owned,
    check_phases,
    phase_configs,
    phase_ends,
    with_changes,
    without_quadrotor,
)
from suite.train.recipes import RECIPES, named_recipe, with_iterations, with_model
from suite.train.run import change_warnings, train, warmup_warnings
from tests.support.training import small_config


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"difficulty": (0.5, 0.2)}, "episode.difficulty is .*lower end of the range first"),
        ({"physics": {"action_delay": (0.0, 3.0)}}, "physics.action_delay is .*allowed is 0 to 2"),
        ({"steps": 6, "image_stride": 4}, "image_stride is 4, allowed are divisors .*6"),
        ({"seed": 2**32}, "seed is 4294967296, allowed"),
    ],
)
def test_worlds_that_cannot_be_made_are_refused_before_anything_is_written(
    changes, words, tmp_path
):
    seed = changes.pop("seed", 0)
    with pytest.raises(ValueError, match=words):
        train(replace(small_config(**changes), seed=seed), tmp_path / "run", Console())
    assert not list(tmp_path.iterdir())


def test_settings_are_changed_by_name():
    changes = ["loss.progress=1", "episode.batch = 8", "physics.drag=(0, 0.5)", "seed=3"]
    changes += ["loss.crash_depth_m=inf", "spec.camera.width=48"]
    config, plain = with_changes(TrainConfig(), changes), TrainConfig()
    assert (config.loss.progress, *config.physics.drag) == (1.0, 0.0, 0.5)
    assert {type(one) for one in (config.loss.progress, *config.physics.drag)} == {float}
    assert (config.episode.batch, config.seed, config.loss.crash_depth_m) == (8, 3, math.inf)
    assert config.spec.camera == replace(plain.spec.camera, width=48)


def test_settings_that_would_do_nothing_or_that_the_command_sets_itself_are_refused():
    run = named_recipe("race")
    for change in ("physics.wind_std=(3,3,1)", "physics.action_delay=(0,2)"):
        with pytest.raises(ValueError, match=r"is of the point mass.*set one of quadrotor\."):
            with_changes(run, [change])
    assert with_changes(run, ["physics.image_delay=2"]).physics.image_delay == 2
    # The vehicle's camera, for example, has no effect on a training.
    for part, option in FROM_FILES.items():
        with pytest.raises(ValueError, match=f"give another file with {option}"):
            with_changes(run, [f"{part}.camera.pitch_deg=30"])
    elsewhere = re.compile(r"seed|phases|sensors|quadrotor$|quadrotor\.vehicle")
    for config in (run, named_recipe("quick")):
        paths = [setting.path for setting in settings_to_change(config)]
        assert paths and not list(filter(elsewhere.match, paths))
    run = named_recipe("paper")
    for change, need, given in (
        ("loss.projection_decay=1", "loss.projection", "3"),
        ("episode.race_share=0.9", "spec.speed_input", "True"),
        ("episode.start_speed=3", "episode.rest_share", "0.5"),
        ("spec.speed=0.5", "spec.speed_input", "True"),
    ):
        with pytest.raises(ValueError, match=rf"has no effect while {need} is (0|1|False)"):
            with_changes(run, [change])
        both = [change, f"{need}={given}"]
        assert with_changes(run, both) == with_changes(run, both[::-1])
    # Only the user's changes must have an effect, and one in a later phase is enough.
    off, own = "spec.speed_input=False", "phases.2.episode.race_share=0.9"
    check_phases(with_changes(named_recipe("race"), [off]))
    with pytest.raises(ValueError, match=r"'phases\.2.*has no effect while spec\.speed_input"):
        with_changes(named_recipe("race"), [off, own])
    with_changes(RUN, ["phases.2.loss.projection=1", "loss.projection_decay=1"])
    check_owned(["loss.progress=1"], {"loss.prog": "", "spec": ""})
    for change in ("spec.rate_hz=30", "phases.2.spec.rate_hz=30"):
        with pytest.raises(ValueError, match=rf"'{change}': this command sets spec.*; take"):
            check_owned([change], {"spec": "take another policy"})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("loss.progres=1", "Did you mean 'progress'"),
        ("progress=2", "unknown setting 'progress'. Did you mean loss.progress"),
        ("loss.rate_hz=20", "unknown setting 'rate_hz'. Did you mean spec.rate_hz"),
        ("lr=1e-3", "unknown setting 'lr'. Did you mean optimizer.rate? suite train --list"),
        ("optimizer.learning_rate=1e-3", "Did you mean optimizer.rate?"),
        ("num_envs=8", "Did you mean episode.batch?"),
        ("epochs=8", ": unknown setting 'epochs'. Known: spec, "),
        ("phases=3", "write phases.N.SETTING=VALUE"),
        ("sensors=vio", "this run has no sensor models; suite train: add --sensors"),
        ("loss=1", "has parts, set one of clearance"),
        ("loss.progress.more=1", "'more' is below a setting that has no parts"),
        ("quadrotor.mass_std=0.1", "this run has no quadrotor; take a recipe"),
        ("loss.progress", "write FIELD=VALUE"),
        ("loss.progress=true", "progress is 'true', allowed is a number, such as 1.2"),
        ("loss.progress=1,loss.jerk=2", "a number, such as 1.2; separate settings by spaces"),
        ("loss.pass_first=yes", "pass_first is 'yes', allowed is True or False"),
        ("episode.batch=1.5", "batch is '1.5', allowed is a whole number, such as 64"),
        ("spec.action.kind=3", "kind is '3', allowed is a text, such as acceleration"),
        ("physics.drag=(1,2,3)", "allowed is a list of 2, such as 0.1,0.8"),
        ("physics.drag=(1,'a')", "allowed is a list of 2, such as 0.1,0.8"),
    ],
)
def test_wrong_settings_are_refused_by_name(change, words):
    with pytest.raises(ValueError) as error:
        with_changes(TrainConfig(), [change])
    assert words in str(error.value) and change in str(error.value)


def test_a_setting_that_is_given_twice_is_refused():
    for path in ("loss.progress", "phases.2.loss.jerk"):
        again = f"{path} = 2"
        with pytest.raises(ValueError, match=f"'{again}': loss.* is given twice; give it once"):
            with_changes(RUN, [f"{path}=1", again])
    options = {"optimizer.rate": "lr", "episode.batch": "num_envs"}
    options |= {"optimizer.iterations": "iterations"}
    for path, option in options.items():
        change, name = f"{path}=8", option.replace("_", "-")
        resolve(Config(recipe="quick", set=(change,)))
        with pytest.raises(ValueError, match=f"this command sets {path}; leave out --{name} or"):
            resolve(Config(recipe="quick", set=(change,), **{option: 8}))
    resolve(Config(lr=1e-3, set=("phases.2.optimizer.rate=1e-4",)))
    with pytest.raises(ValueError, match="this command sets seed; give --seed"):
        resolve(Config(recipe="quick", seed=0, set=("seed=5",)))


def test_spreads_go_with_the_size_of_the_vehicle_that_is_asked_for():
    own = named_recipe("race")
    assert own.quadrotor is not None and own.quadrotor.vehicle.name == "racer5"
    other = with_model(own, "quad", "crazyflie21").quadrotor
    assert other is not None and other.vehicle.name == "crazyflie21"
    # What is a torque or a length goes with the vehicle's, all else is the recipe's.
    small, racer = other.vehicle.inertia, own.quadrotor.vehicle.inertia
    share = (small[0] + small[1]) / (racer[0] + racer[1])
    assert other.trim_std == pytest.approx(share * own.quadrotor.trim_std) and share < 0.01
    assert 0.2 < other.com_std_m / own.quadrotor.com_std_m < 0.5
    sizes = {"trim_std": own.quadrotor.trim_std, "com_std_m": own.quadrotor.com_std_m}
    assert replace(other, vehicle=own.quadrotor.vehicle, **sizes) == own.quadrotor
    assert with_model(own, "quad", "racer5") == own, "to the bit"


def test_another_rate_keeps_rollouts_and_delays_in_seconds():
    slow = phase_configs(named_recipe("race"))[0]
    fast = at_rate(slow, 30.0)
    assert (fast.episode.steps, fast.episode.image_stride) == (180, 6)
    assert fast.physics.action_delay == (0.0, 2.0), "not 3: the point mass holds no more"
    assert at_rate(fast, 15.0).episode == slow.episode and at_rate(slow, 15.0) == slow
    odd = at_rate(slow, 20.0)
    assert (odd.episode.steps, odd.episode.image_stride) == (120, 4)
    for config in (fast, odd):
        check(config)
    late = at_rate(named_recipe("paper"), 30.0).physics
    assert (late.state_delay, late.image_delay) == (2, 4)


def test_a_changed_rate_keeps_the_length_of_rollouts_unless_that_is_changed_too():
    def seconds(*changes, recipe="race"):
        run = with_changes(named_recipe(recipe), changes)
        check_phases(run)
        return [phase.episode.steps / phase.spec.rate_hz for phase in phase_configs(run)]

    assert seconds("spec.rate_hz=50") == seconds("phases.3.spec.rate_hz=60") == [6.0] * 3
    assert seconds("phases.2.spec.rate_hz=30") == seconds("spec.rate_hz=15") == [6.0] * 3
    assert seconds("spec.rate_hz=30", "episode.steps=90", "episode.image_stride=3") == [3.0] * 3
    assert seconds("spec.rate_hz=30", recipe="paper") == [10.0]
    late = with_changes(named_recipe("paper"), ["spec.rate_hz=30", "physics.image_delay=3"])
    assert (late.physics.state_delay, late.physics.image_delay) == (2, 3)


def test_the_papers_recipe_has_the_papers_weights():
    loss = named_recipe("paper").loss
    assert (loss.clearance, loss.collide) == (3.0, 3.0)
    assert (loss.acceleration, loss.jerk, loss.progress) == (1e-2, 1e-3, 0.4)
    assert loss.progress_norm == loss.projection == 0.0
    assert (losses.BARRIER_HEIGHT, losses.BARRIER_SLOPE, losses.FIELD_DECAY) == (2.0, -32.0, 0.3)


PHASES = (
    Phase(0.5),
    Phase(0.3, ("loss.progress=2.0", "optimizer.rate=1e-3")),
    Phase(0.2, ("spec.rate_hz=30.0",)),
)
RUN = with_iterations(TrainConfig(phases=PHASES), 10)


def test_a_phase_keeps_what_came_before_and_a_change_holds_in_all_or_in_the_one_that_is_named():
    assert phase_ends(RUN) == (5, 8, 10)
    first, second, third = phase_configs(RUN)
    assert [one.optimizer.iterations for one in (first, second, third)] == [5, 3, 2]
    assert [one.loss.progress for one in (first, second, third)] == [1.2, 2.0, 2.0]
    assert [one.spec.rate_hz for one in (first, second, third)] == [15.0, 15.0, 30.0]
    assert all(one.phases == () for one in (first, second, third))
    assert phase_configs(TrainConfig()) == (TrainConfig(),)
    everywhere = phase_configs(with_changes(RUN, ["loss.progress=0.4"]))
    assert [one.loss.progress for one in everywhere] == [0.4] * 3
    assert everywhere[1].optimizer.rate == 1e-3, "other changes of the phase stay"
    alone = phase_configs(with_changes(RUN, ["phases.3.loss.progress=0.4", "loss.jerk=0.5"]))
    assert [one.loss.progress for one in alone] == [1.2, 2.0, 0.4]
    assert [one.loss.jerk for one in alone] == [0.5] * 3
    both = with_changes(RUN, ["phases.2. optimizer.rate = 2e-4", "optimizer.rate=5e-4"])
    assert [one.optimizer.rate for one in phase_configs(both)] == [5e-4, 2e-4, 2e-4]
    again = phase_configs(with_changes(both, ["optimizer.rate=3e-4"]))
    assert [one.optimizer.rate for one in again] == [3e-4] * 3
    for number in ("0", "4", "x"):
        with pytest.raises(ValueError, match="this run has 3 phases"):
            with_changes(RUN, [f"phases.{number}.loss.progress=1"])
    with pytest.raises(ValueError, match="this run has no phases; write SETTING=VALUE"):
        with_changes(TrainConfig(), ["phases.1.loss.progress=1"])
    with pytest.raises(ValueError, match="shares .* set optimizer.iterations without a phase"):
        with_changes(RUN, ["phases.2.optimizer.iterations=5"])
    two = ["phases.2.loss.jerk=1", "phases.2.loss.collide=1"]
    assert with_changes(RUN, two) == with_changes(RUN, two[::-1])
    recipe = without_quadrotor(named_recipe("race"))
    check_phases(recipe)
    assert all(one.quadrotor is None for one in phase_configs(recipe))


@pytest.mark.parametrize(
    ("run", "changes", "words"),
    [
        ("race", ["phases.2.loss.tilt=5"], r"loss.tilt is 5.0 until phase 3 of 3, .* to 40.0; to"),
        ("race", ["phases.1.loss.progress=1"], "give phases.2.loss.progress as well"),
        ("race", ["episode.steps=90", "phases.3.spec.rate_hz=60"], "steps is 90 until phase 3"),
        ("race", ["phases.2.loss.tilt=5", "phases.3.loss.tilt=6"], None),
        ("race", ["phases.2.loss.collide=5", "loss.tilt=6"], None),
        ("quick", ["loss.tilt=5"], "loss.tilt has no gradient through the point mass"),
        ("quick", ["loss.tilt=0", "loss.jerk=1"], None),
    ],
)
def test_changes_that_a_later_phase_undoes_or_without_a_gradient_give_a_warning(
    run, changes, words
):
    warnings = change_warnings(with_changes(named_recipe(run), changes), changes)
    assert len(warnings) == (words is not None), warnings
    assert words is None or re.search(words, warnings[0])


def test_a_warning_of_the_warm_up_names_the_phase():
    changes = ["optimizer.warmup=2"]
    (warning,) = warmup_warnings(with_changes(RUN, changes))
    assert warning.startswith("phase 3 of 3: 2 gradient steps, not more than the warm-up")
    (warning,) = warmup_warnings(with_iterations(TrainConfig(), 1))
    assert warning.startswith("1 gradient step, not")


def test_recipes_are_within_the_limits_and_their_phases_share_any_number_of_iterations():
    for recipe in map(named_recipe, RECIPES):
        check_phases(recipe)
        for total in (3, 7, 100, 4500, 4501):
            ends = phase_ends(with_iterations(recipe, total))
            assert ends[-1] == total and list(ends) == sorted(ends)


@pytest.mark.parametrize(
    ("second", "words"),
    [
        (Phase(0.4), "shares of phases add up to 0.9, allowed is 1"),
        (Phase(0.5, ("loss.progres=1",)), "phase 2: .*Did you mean 'progress'"),
        (Phase(0.5, ("episode.batch=2",)), "phase 2 changes episode.batch"),
        (Phase(0.5, ("spec.hidden_size=64",)), "phase 2 changes spec"),
        (Phase(0.5, ("episode.image_stride=7",)), "image_stride is 7"),
        (Phase(0.5, ("spec.action.kind=ctbr",)), "kind is ctbr, allowed .* is acceleration"),
    ],
)
def test_phases_that_cannot_be_trained_are_refused(second, words):
    with pytest.raises(ValueError, match=words):
        check_phases(replace(RUN, phases=(Phase(0.5), second)))
