"""One change of a recipe at a time: the rows, their numbers by hand, and the whole command."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suite.console import Console
from suite.reproduce import ideas
from suite.reproduce.ideas import Config, judged_ideas, round_ideas
from suite.reproduce.ideas_tables import compared, lead
from suite.reproduce.trainings import trained_policy
from suite.train.overrides import override
from tests.reproduce.test_ablation import SMALL
from tests.support.documents import page, reproduce


def test_every_row_is_the_recipe_with_its_changes():
    rows = judged_ideas(Config()) + round_ideas(Config())
    base = rows[0].recipe
    assert base.episode.image_stride == 3 and not rows[0].changes
    for row in rows[1:]:
        assert row.changes and row.recipe == override(base, row.changes) != base
    by_key = {row.key: row.recipe for row in rows}
    assert len(by_key) == len(rows)
    longer, truncated = by_key["longer"], by_key["longer, truncated"]
    assert longer.episode.steps * longer.episode.batch == base.episode.steps * base.episode.batch
    assert truncated.episode == longer.episode
    assert truncated.loss.gradient_decay == pytest.approx(2 * base.loss.gradient_decay)
    assert by_key["L_proj"].loss.field_gain == 0 < by_key["field and L_proj"].loss.field_gain
    assert by_key["round"].episode == by_key["round, square field"].episode
    assert [row.key for row in judged_ideas(Config(only=("longer",)))] == ["recipe", "longer"]
    assert not round_ideas(Config(only=("longer",)))


def flown(*won) -> list[Any]:
    """Return trials with what a row looks at."""
    ends = {1: "finished", 0: "collision"}
    return [SimpleNamespace(success=w == 1, v_max=4.0 + w, ended_by=ends[w]) for w in won]


def test_differences_and_verdicts_by_hand():
    base = np.array([[1, 0, 0, 0] * 5, [0, 0, 0, 0] * 5], bool)
    better = compared("a", [flown(*[1, 1, 0, 0] * 5), flown(*[1, 0, 0, 0] * 5)], base)
    assert better.success == [0.5, 0.25] and better.of_seeds == [0.25, 0.25]
    assert better.difference.value == 0.25 and better.difference.low > 0
    assert better.verdict == "gain" and better.v_max == 4.0
    # As much over all trials, but one seed is worse.
    torn = compared("b", [flown(*[1, 1, 1, 1] * 5), flown(*[0] * 20)], base)
    assert torn.difference.low > 0 and torn.of_seeds == [0.75, 0.0] and torn.verdict == "unclear"
    worse = compared("c", [flown(*[0] * 20), flown(*[0] * 20)], np.ones((2, 20), bool))
    assert worse.verdict == "loss" and worse.of_seeds == [-1, -1]
    same = compared("recipe", [flown(*row) for row in base], base)
    said = lead([same, better, torn, worse])
    assert said.startswith("Of the recipe's trials 12 % succeed. More succeed with a (+25 [")
    assert "Fewer succeed with c (-100 [-100, -100])." in said and "do not tell for b." in said


def test_the_rows_are_trained_and_judged_once(sky, made, tmp_path, monkeypatch):
    numbers = {"success_cross": 0.5, "success_rate": 1.0, "v_max": 3.0, "gates": 6.0}
    seen = []
    monkeypatch.setattr(
        "suite.reproduce.validation.make_validation",
        lambda recipe, trials, seed: lambda params: seen.append((recipe, trials, seed)) or numbers,
    )
    args = ["ideas", "--trials", "1", "--difficulty", "0", "--training-seeds", "3", "5"]
    assert reproduce(tmp_path, *args) == 0
    rows = len(judged_ideas(Config()))
    assert len(made) == (rows + 2) * 2 and {c.seed for c in made} == {3, 5}
    assert len(sky.flown) == rows * 2 * 3
    assert [recipe.loss.field_square for recipe, *_ in seen] == [False, False, True, True]
    assert {(recipe.episode.gate_corners, t, s) for recipe, t, s in seen} == {(8, 300, 1000)}
    text, found = page(tmp_path, "ideas")
    assert [row["key"] for row in found["rows"]][:2] == ["recipe", "second gate"]
    assert "| round | the field of the round gate | 50 [50, 50] | 100 [100, 100] |" in text
    assert "`loss.path_samples=1`" in text
    assert reproduce(tmp_path, *args) == 0
    assert len(made) == (rows + 2) * 2 and len(sky.flown) == rows * 6, "all is there"


def test_round_gates_are_flown_by_the_trainers_own_code(tmp_path):
    small = Config(set=(*SMALL, "episode.batch=2"), iterations=1, round_trials=2)
    recipe = round_ideas(small)[0].recipe
    policy = trained_policy(recipe, Console(), tmp_path)
    found = ideas._flown_round(policy, recipe, small)
    assert found["gates"] == 0 and 0 <= found["success_rate"] <= 1 and found["v_max"] > 0


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--only", "second gat"], "Did you mean 'second gate'?"),
        (["--training-seeds", "1", "1"], "--training-seeds is 1 1"),
        (["--round-trials", "0"], "--round-trials is 0"),
        (["--jobs", "0"], "--jobs is 0"),
    ],
)
def test_what_cannot_be_used_is_said_before_anything_is_trained(
    args, words, made, tmp_path, capsys
):
    assert reproduce(tmp_path, "ideas", *args) == 2
    assert words in capsys.readouterr().err
    assert not made and not list(tmp_path.iterdir())
