"""What randomisation buys: two settings of one recipe, flown in pairs."""

from dataclasses import replace

import numpy as np
import pytest

from suite.experiments.randomisation import ALL, compare, fixed, lead
from suite.train.presets import preset
from tests.support.documents import page, reproduce

ARGS = ["randomisation", "--only", "wind", "--trials", "2", "--difficulty", "0"]


def test_fixed_dynamics_are_the_middle_and_all_else_is_the_recipe():
    recipe = preset("swift")
    still = fixed(recipe)
    assert replace(still, physics=recipe.physics) == recipe
    physics = still.physics
    assert physics.drag == pytest.approx((0.45, 0.45))
    assert physics.drag_up == pytest.approx((1.1, 1.1))
    assert physics.action_delay == (0.75, 0.75) and physics.lag_mean == recipe.physics.lag_mean
    assert not (physics.lag_std or any(physics.wind_std) or physics.time_step_std)
    assert physics.depth_noise == 0 and physics.fov_scale == (1, 1)


@pytest.mark.slow
def test_both_settings_of_every_seed_fly_the_same_share(sky, made, tmp_path):
    args = [*ARGS, "--training-seeds", "3", "5", "--iterations", "7"]
    assert reproduce(tmp_path, *args) == 0
    assert [(c.seed, c.physics.lag_std) for c in made] == [(3, 0), (5, 0), (3, 2), (5, 2)]
    assert {c.optimizer.iterations for c in made} == {7}
    # Undisturbed once for all and four winds; three tracks, two seeds, two settings.
    assert len(sky.flown) == (1 + 4) * 3 * 2 * 2
    text, numbers = page(tmp_path, "randomisation")
    assert list(numbers["compared"]) == ["undisturbed", "wind", "all disturbances"]
    assert "| wind | 0 | 0 | +0 [+0, +0] | +0 +0 |" in text and "do not tell for: undis" in text
    assert "| 3 | 3 | 0 | 0 | 0 | 0 |" in text and "| 5 | 3 | 0 | 0 | 0 | 0 |" in text
    assert reproduce(tmp_path, *args) == 0
    assert len(made) == 4 and len(sky.flown) == 60, "the second time all is there"


def test_a_trials_conditions_are_one_draw():
    # Twenty trials; b alone wins the first half of each seed's, under each of five conditions.
    first = np.tile([True] * 5 + [False] * 5, 2)
    won = {"a": np.zeros((5, 20), bool), "b": np.tile(first, (5, 1))}
    once = compare({name: each[:1] for name, each in won.items()}, [10, 10])
    often = compare(won, [10, 10])
    assert once.gap == often.gap
    assert often.gap.difference.value == 0.5 and often.gap.of_seeds == [0.5, 0.5]
    assert often.gap.difference.low == pytest.approx(0.3, abs=0.06)
    assert often.rates["b"].value == 0.5 and often.rates["a"].value == 0


def test_a_seed_that_does_not_agree_is_no_gain():
    won = {"a": np.zeros((1, 90), bool), "b": np.zeros((1, 90), bool)}
    won["b"][0, :60] = True
    torn = compare(won, [30, 30, 30])
    assert torn.gap.of_seeds == [1.0, 1.0, 0.0] and torn.gap.verdict == "unclear"
    won["b"][0, 60:75] = True
    agreed = compare(won, [30, 30, 30])
    assert agreed.gap.verdict == "gain"
    said = lead({"undisturbed": torn, ALL: agreed})
    assert said.endswith(
        "Randomisation gains in: all disturbances. These trainings do not tell for: undisturbed."
    )


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--only", "linear_drag"], "linear_drag"),
        (["--training-seeds", "1", "1"], "--training-seeds is 1 1"),
        (["--iterations", "0"], "--iterations is 0"),
        (["--workers", "99"], "--workers is 99"),
    ],
)
def test_what_cannot_be_used_is_said_before_anything_is_trained(
    args, words, made, tmp_path, capsys
):
    begun = ["randomisation"] if "--only" in args else ARGS
    assert reproduce(tmp_path, *begun, *args) == 2
    assert words in capsys.readouterr().err
    assert not made and not list(tmp_path.iterdir())
