"""suite reproduce at a small size: every document from one command, resumed, from the cache."""

import json

import pytest

from suite import cli
from suite.experiments import EXPERIMENTS
from tests.support.documents import another_racer, page, reproduce


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_has_help_for_every_option(name, capsys):
    assert cli.main(["reproduce", name, "--help"]) == 0
    said = capsys.readouterr().out
    assert "--out" in said and "--cache" in said and "--json" in said


def test_an_experiment_that_does_not_exist_is_code_2(capsys):
    assert cli.main(["reproduce", "table3"]) == 2
    assert "table2" in capsys.readouterr().err


def test_table2_and_all_levels(sky, tmp_path, capfd):
    sky.stop_after = 11
    assert reproduce(tmp_path, "table2", "--trials", "1", "--seed", "7") == 130
    assert not (tmp_path / "docs").exists() and len(sky.flown) == 11
    assert reproduce(tmp_path, "table2", "--trials", "1", "--seed", "7") == 0
    assert "11 of 30 trials were flown before" in capfd.readouterr().err
    assert len(sky.flown) == len(set(trial for *_, trial in sky.flown)) == 30
    text, numbers = page(tmp_path, "table2")
    assert {(cell["track"], cell["difficulty"]) for cell in numbers["cells"]} == {
        (track, level) for track in ("zigzag", "circular", "ellipse") for level in range(10)
    }
    # In a second nobody finishes: every cell misses what is asked of it, and says by how much.
    assert "0 of 12 cells meet the whole goal" in text
    assert all(goal["success_miss"] > 0 for goal in numbers["goals"]["ours"])
    assert "| 90.0 points | 97 % | 97.0 points |" in text
    assert "no row of ours with the Delta Action Model" in text
    assert "| paper, with Delta Action Model | 9 | 7/10 | 6.1 |" in text
    assert "seeds: 7 to 7, 1 trials a cell" in text
    # Other documents find the flights of this one.
    assert reproduce(tmp_path, "seeds", "--policies", "swift", "--trials", "1", "--seed", "7") == 0
    assert len(sky.flown) == 30
    text, numbers = page(tmp_path, "seeds")
    assert numbers["spread"]["median"] == "swift"
    # A second time nothing is flown and the same is written.
    capfd.readouterr()
    assert reproduce(tmp_path, "table2", "--trials", "1", "--seed", "7", "--json") == 0
    said = json.loads(capfd.readouterr().out)
    assert said["out"].endswith("table2.md") and len(said["cells"]) == 30
    assert len(sky.flown) == 30


def test_table2_with_policies_tuned_under_the_delta_model(sky, tmp_path):
    tuned = tmp_path / "tuned"
    another_racer(tuned, 1001)
    args = ["--trials", "1", "--delta-policy", str(tuned)]
    assert reproduce(tmp_path, "table2", *args) == 0
    assert len(sky.flown) == 30 + 12, "the paper's four levels"
    text, numbers = page(tmp_path, "table2")
    assert {cell["policy"] for cell in numbers["cells"]} == {
        "ours",
        "ours, with Delta Action Model",
    }
    assert "no row of ours" not in text and "The goal, cell by cell: ours, with" in text
    assert not numbers["with_against_without"], "without its control nobody knows its merit"
    another_racer(tuned, 1002)
    args = [*args, "--control-policy", "racer"]
    assert reproduce(tmp_path, "table2", *args) == 0
    text, numbers = page(tmp_path, "table2")
    overall = numbers["with_against_without"][-1]
    assert overall["track"] == "all" and overall["trials"] == 12
    assert "What the Delta Action Model changes" in text and "with - without" in text


def test_robustness(sky, tmp_path, capfd):
    only = ["--only", "wind", "mass_offset", "gate-pose error"]
    args = [*only, "--trials", "1", "--difficulty", "0", "--policy", "racer"]
    sky.stop_after = 5
    assert reproduce(tmp_path, "robustness", *args) == 130
    assert reproduce(tmp_path, "robustness", *args) == 0
    # Undisturbed once for all, two signs of mass, four winds, four gate errors; three tracks.
    assert len(sky.flown) == 3 * (1 + 2 + 4 + 4)
    winds = {flight[1].effects["constant_wind"].velocity for flight in sky.flown
             if "constant_wind" in flight[1].effects}  # fmt: skip
    assert sorted(round(y / 0.8) for _, y, _ in winds) == [2, 4, 6, 8]
    assert {flight[2].gate_m for flight in sky.flown} == {0, 0.05, 0.1, 0.2, 0.3}
    text, numbers = page(tmp_path, "robustness")
    assert len(numbers["conditions"]) == 1 + 2 + 5 + 5
    assert text.count("| 0 % [0, 56] |") == 13
    assert "gyro_bias, accelerometer_bias and clock_offset are faults" in text
    assert (tmp_path / "docs" / "robustness-2.png").is_file()


def test_what_randomisation_buys_is_two_policies_side_by_side(sky, tmp_path):
    other = tmp_path / "other"
    another_racer(other, 1001)
    both = ["--policy", "racer", "--policy", str(other)]
    args = [*both, "--only", "depth noise", "--trials", "1", "--difficulty", "0"]
    assert reproduce(tmp_path, "robustness", *args) == 0
    text, numbers = page(tmp_path, "robustness")
    assert "| other - racer |" in text and "| racer: success |" in text
    # The same network on the same trials under the same noise: no difference in any number.
    for condition in numbers["conditions"]:
        one, two = condition["policies"].values()
        assert one == two


def test_seeds_are_trained_once_and_compared(sky, made, tmp_path):
    recipe = ["--preset", "small", "--iterations", "3", "--set", "episode.batch=2"]
    args = [*recipe, "--training-seeds", "0", "4", "--trials", "1"]
    assert reproduce(tmp_path, "seeds", *args) == 0
    assert [(c.seed, c.optimizer.iterations, c.episode.batch) for c in made] == [
        (0, 3, 2),
        (4, 3, 2),
    ]
    assert reproduce(tmp_path, "seeds", *args) == 0
    assert len(made) == 2 and len(sky.flown) == 24
    text, numbers = page(tmp_path, "seeds")
    assert set(numbers["spread"]["mean_success"]) == {"seed 0", "seed 4"}
    assert "small episode.batch=2" in text


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["table2", "--trials", "0"], "--trials is 0"),
        (["table2", "--policy", "racr"], "Did you mean 'racer'?"),
        (["table2", "--delta-policy", "nowhere/policy"], "nowhere/policy: no such file"),
        (["table2", "--delta-policy", "x", "--delta-iterations", "3"], "give the one or the other"),
        (["table2", "--vehicle", "referense"], "Did you mean 'reference'?"),
        (["robustness", "--only", "linear_darg"], "Did you mean 'linear_drag'?"),
        (["robustness", "--policy", "racer", "--policy", "racer"], "given twice"),
        (["seeds", "--preset", "smal"], "Did you mean 'small'?"),
        (["seeds", "--training-seeds", "1", "1"], "--training-seeds is 1 1"),
        (["seeds", "--policies", "racer", "--trials", "0"], "--trials is 0"),
        (["seeds", "--jobs", "0"], "--jobs is 0"),
    ],
)
def test_what_cannot_be_used_is_said_before_anything_is_flown(args, words, sky, tmp_path, capsys):
    assert reproduce(tmp_path, *args) == 2
    said = capsys.readouterr().err
    assert words in said and len(said.strip().splitlines()) == 1
    assert not sky.flown and not list(tmp_path.iterdir())
