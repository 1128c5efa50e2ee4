"""What a loop's options come to: its stages, what it refuses, measured flights, standings."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eval.logs.flight_log import read_flights, write_flight
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from policies import shipped
from suite.common.errors import WorkFailed
from suite.common.stages import is_done
from suite.common.usage import renamed
from suite.delta.replay import nominal_model
from suite.loop import delta_action, hidden_effect, measured
from suite.loop.compare import cell_grid, overall_grid, policy_results
from suite.loop.config import loop_by_content
from suite.loop.hidden_effect import LABELS
from suite.loop.variants import DeltaModel, Variant
from suite.loop.work import LoopRun, Quiet, plan
from suite.train.config import PointMassConfig
from tests.support import commands
from tests.support.judged_cells import results_of
from tests.support.loops import resolve
from tests.support.point_mass_flights import fly
from tests.support.vehicles import with_effects

EXAMPLE = "examples/hidden.toml"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("--policy nobody.onnx", "give a checkpoint's folder"),
        ("--track my.toml", "would be the same; give families"),
        ("--track random", "the fine-tunings train on this family"),
        ("--trials 0", "--trials is 0"),
        ("--flights 1 --track zigzag --difficulty 0", "--flights is 1"),
        ("--no-delta", "without --hidden-vehicle the loop needs the Delta Action Model"),
        ("--set optimizer.iterations=5", "give --iterations"),
        ("--policy race-paper --set optimizer.iterations=5", "give --finetune-iterations"),
        ("--policy race-paper --set spec.rate_hz=30", "sets spec.rate_hz; a policy keeps"),
        ("--policy race-paper --set phases.1.loss.progress=1", "this run has no phases"),
        ("--hidden-vehicle {0} --set quadrotor.vehicle.mass=0.9", "another file with --vehicle"),
        ("--policy race-paper --iterations 5", "--iterations is 5, but with --policy, --hidden"),
        ("--hidden-vehicle reference", "nothing is hidden"),
        ("--simulator mjx", "nothing is hidden"),
        ("--hidden-vehicle {0} --no-delta --fit-iterations 5", "--fit-iterations is 5, but"),
        ("--hidden-vehicle {0} --set quadrotor.mas_std=0", "Did you mean 'mass_std'"),
    ],
)
def test_what_cannot_be_used_is_refused_before_any_writing(line, words, tmp_path, root, capsys):
    asked = f"loop {line.format(root / EXAMPLE)} --out"
    assert words in commands.refused(capsys, asked, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_inputs_in_the_folder_of_the_loop_are_neither_copied_into_themselves_nor_overwritten(
    tmp_path, root, capsys
):
    policy = tmp_path / "mine"
    shutil.copytree(shipped.locate("race-paper"), policy)
    before = sorted(policy.iterdir())
    for out in (policy, policy / "loop"):
        words = commands.refused(capsys, f"loop --policy {policy} --out", out)
        assert f"is in the folder of the policy {policy}" in words
    file = tmp_path / "out" / "diagnosis" / "vehicle.toml"
    file.parent.mkdir(parents=True)
    shutil.copy(root / EXAMPLE, file)
    words = commands.refused(capsys, f"loop --hidden-vehicle {file} --out", tmp_path / "out")
    assert f"{file} is also an input and would be overwritten" in words
    assert sorted(policy.iterdir()) == before and not (tmp_path / "out" / "run.json").exists()


def test_a_copy_hides_nothing_and_a_load_on_a_line_may_be_hidden_only(tmp_path, root):
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


def test_a_policys_folder_with_the_name_of_a_recipe_has_the_recipe_of_any_other(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for name in ("quick", "mine"):
        shutil.copytree(shipped.locate("race-paper"), name)
    quick, mine = resolve(policy="quick"), resolve(policy="mine")
    assert quick.trials == mine.trials == 50 and quick.tuning == mine.tuning


def test_settings_are_of_the_fine_tuning_and_its_rate_where_a_policy_is_given():
    """Else of the recipe, which the fine-tuning follows at its share of the learning rate."""
    changes = ("optimizer.rate=1e-4", "episode.rest_share=0.2")
    given = resolve(policy="race-paper", set=changes).tuning
    assert (given.optimizer.rate, given.episode.rest_share) == (1e-4, 0.2)
    trained = resolve(recipe="quick", set=changes).tuning
    assert (trained.optimizer.rate, trained.episode.rest_share) == (pytest.approx(3e-5), 0.2)
    # A policy of 30 Hz has 180 steps where the recipe has 90, which 4 does not divide.
    changes = ("episode.image_stride=4",)
    found = resolve(policy="race", recipe="race-paper", set=changes)
    assert found.tuning.episode.steps == 180
    with pytest.raises(ValueError, match=r"divisors of episode.steps \(90\)"):
        resolve(recipe="race-paper", set=changes)


def hidden_loop(policy="race-paper", hidden="racer5"):
    return resolve(recipe="quick", policy=policy, hidden_vehicle=str(hidden))


def test_where_files_lie_makes_no_other_loop(root, tmp_path):
    here, there, other = root / EXAMPLE, tmp_path / "hidden.toml", tmp_path / "other.toml"
    there.write_bytes(here.read_bytes())
    save_vehicle(with_effects(com_offset=((0.005, 0.0, 0.0),)), other)
    loops = [hidden_loop(hidden=path) for path in (here, there, other)]
    one, same, another = map(loop_by_content, loops)
    assert loops[0] != loops[1] and one == same != another


def test_a_folder_called_like_something_shipped_makes_no_other_loop(tmp_path, monkeypatch):
    """It is not what is loaded, and may come between an interruption and the same command again."""
    monkeypatch.chdir(tmp_path)
    begun = loop_by_content(hidden_loop())
    for name in ("race-paper", "racer5", "reference"):
        (tmp_path / name).mkdir()
    assert loop_by_content(hidden_loop()) == begun
    (tmp_path / "racer5").rmdir()
    shutil.copytree(shipped.locate("race-paper"), tmp_path / "mine")
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
    loop = replace(run.loop, variants=variants, models=models)
    names = [stage.name for stage in plan(replace(run, loop=loop))]
    assert names.index("other") < names.index("tuned-longer") < names.index("eval-longer")
    assert len(names) == 9 + 3


def test_a_vehicle_file_that_changes_during_a_loop_stops_it(tmp_path):
    file = tmp_path / "true.toml"
    save_vehicle(load_vehicle("racer5"), file)
    run = LoopRun(hidden_effect.LOOP, hidden_loop(hidden=file), tmp_path / "out", Quiet(), 4)
    stages = {stage.name: stage for stage in plan(run)}
    single = {stage.name: stage for stage in plan(replace(run, workers=None))}
    together, alone = stages["tuned-named"].estimate, single["tuned-named"].estimate
    assert together.memory_bytes == 4 * alone.memory_bytes, "four fine-tunings at once"
    stages["given"].work(tmp_path / "out" / "given")
    save_vehicle(replace(load_vehicle("racer5"), mass=0.6), file)
    with pytest.raises(ValueError, match="--hidden-vehicle has changed since the loop began"):
        stages["eval-before"].work(tmp_path / "out" / "eval-before")
    assert not (tmp_path / "out" / "eval-before").exists()


def test_flights_that_cannot_be_fitted_end_the_loop_with_advice(tmp_path):
    run = LoopRun(delta_action.LOOP, resolve(recipe="quick", trials=3), tmp_path, Quiet())
    stage = next(stage for stage in plan(run) if stage.name == "delta")
    with pytest.raises(WorkFailed, match="cannot be fitted.*--iterations"):
        stage.work(tmp_path / "delta")
    assert not is_done(tmp_path / "delta")


def test_differences_are_of_the_same_trials_and_none_is_called_none():
    results = results_of({"before": 10, "without": 20, "with": 30})
    policies = policy_results(results, delta_action.REFERENCES)
    assert [one.success.value for one in policies] == pytest.approx([0.25, 0.5, 0.75])
    said = "75 % of 40 trials succeed: more than the same fine-tuning without it (50 %; difference"
    assert said in delta_action.verdict(policies, 40)
    equal = policy_results(dict.fromkeys(results, results["before"]), delta_action.REFERENCES)
    assert "not significantly different from" in delta_action.verdict(equal, 40)
    cell = overall_grid(equal, delta_action.REFERENCES, delta_action.LABELS, 40).rows[2][3]
    assert cell.tone == "" and cell.text.startswith("+0 [")


def test_standings_are_paired_by_trial():
    won = {"nominal": 39, "before": 10, "control": 12, "delta": 20, "named": 36, "both": 40}
    results, references = results_of(won), ("before", "control", "nominal")
    stand = policy_results(results, references)
    named = stand[4]
    assert named.success.value == pytest.approx(0.9) and named.gates.value == pytest.approx(7.5)
    assert [d.against for d in named.differences] == [*references]
    assert named.differences[0].success.value == pytest.approx(26 / 40)
    # 26 pairs, all one way: 2 / 2^26 by hand.
    assert named.differences[0].p_value == pytest.approx(2 / 2**26)
    assert named.by_cell["zigzag 0"].value == pytest.approx(18 / 20)
    assert [d.against for d in stand[1].differences] == ["control", "nominal"]
    grid = overall_grid(stand, references, LABELS, 40)
    assert {len(row) for row in grid.rows} == {len(grid.headers)}
    assert grid.rows[4][2].tone == "good" and grid.rows[1][2].text == ""
    cells = cell_grid(stand, LABELS)
    assert len(cells.rows) == 2 and cells.rows[0][5].text.startswith("90 % [")
    with pytest.raises(ValueError, match="same trials"):
        policy_results({**results, "both": results["both"][::-1]}, ("before",))


@pytest.fixture(scope="module")
def logs():
    flown = fly(nominal_model(PointMassConfig()), 3, seconds=4.0)
    thrust = np.full_like(flown[0].time_s, 9.81)
    return [replace(log, thrust_cmd=thrust, rate_cmd_b=log.rate_b) for log in flown]


def test_ends_are_cut_and_noise_is_of_its_size(logs):
    log = logs[0]
    short = measured.cut_end(log, 0.5)
    assert log.time_s[-1] - short.time_s[-1] == pytest.approx(0.5, abs=0.034)
    assert len(short.pos_w) == len(short.extra["action_x"]) == len(short.time_s) < len(log.time_s)
    shaken = measured.noisy(log, np.random.default_rng(0))
    turn = np.einsum("nij,nik->njk", log.rot_w, shaken.rot_w)
    angle = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], -1)
    assert angle.std() == pytest.approx(measured.NOISE["attitude"], rel=0.2)
    assert (shaken.rate_b - log.rate_b).std() == pytest.approx(measured.NOISE["gyro"], rel=0.2)
    np.testing.assert_allclose(np.linalg.norm(shaken.quat_wxyz, axis=1), 1, atol=1e-12)
    np.testing.assert_array_equal(shaken.thrust_cmd, log.thrust_cmd)


def test_crashed_flights_lose_their_end_and_short_ones_are_left_out(logs, tmp_path):
    flights, out = tmp_path / "flights", tmp_path / "out"
    rows = [{"file": None, "track": "zigzag", "difficulty": 0, "ended_by": "collision"}]
    # The last is too short to be used.
    flown = (*logs[:2], measured.cut_end(logs[2], logs[2].duration_s - 1.2))
    for log, ended_by in zip(flown, ("collision", "timeout", "finished"), strict=True):
        about = {**log.about, "vehicle": "hidden"}
        file = write_flight(flights / f"{ended_by}.parquet", replace(log, about=about))
        rows.append({**rows[0], "file": file.name, "ended_by": ended_by})
    (flights / "flights.json").write_text(json.dumps({"flights": rows}))
    files = measured.add_measurement_noise(flights, out, 0)
    assert all("vehicle" not in log.about for log in read_flights(files)[0]), "it is hidden"
    assert [file.name for file in files] == ["collision.parquet", "timeout.parquet"]
    cut, whole = read_flights(files)[0]
    lost_s = logs[0].duration_s - cut.duration_s
    assert lost_s == pytest.approx(measured.CONTACT_MARGIN_S, abs=0.034)
    assert whole.duration_s == logs[1].duration_s
    noise = (whole.pos_w - logs[1].pos_w).std()
    assert noise == pytest.approx(measured.NOISE["pos"], rel=0.2)
    np.testing.assert_array_equal(whole.action_b, logs[1].action_b)
    (flights / "flights.json").write_text(json.dumps({"flights": rows[:1]}))
    with pytest.raises(ValueError, match="no flight in .* is 1.5 s long"):
        measured.add_measurement_noise(flights, tmp_path / "none", 0)


def test_the_diagnosis_gets_five_flights_or_as_many_as_are_long_enough(logs, tmp_path):
    files = [tmp_path / f"{number}.parquet" for number in range(7)]
    for file in files:
        write_flight(file, logs[0])
    assert measured.first_files(files, 1.0) == files[:5]
    assert measured.first_files(files, 5.5 * logs[0].duration_s) == files[:6]
    assert measured.first_files(files, 99.0 * logs[0].duration_s) == files
