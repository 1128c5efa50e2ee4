"""What randomisation buys: two settings of one recipe, flown in pairs."""

from dataclasses import replace

import numpy as np
import pytest

from suite.reproduce.randomisation import fixed
from suite.reproduce.randomisation_tables import compare
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


def test_both_settings_of_every_seed_fly_the_same_share(sky, made, tmp_path):
    args = [*ARGS, "--training-seeds", "3", "5", "--iterations", "7"]
    assert reproduce(tmp_path, *args) == 0
    assert [(c.seed, c.physics.lag_std) for c in made] == [(3, 0), (5, 0), (3, 2), (5, 2)]
    assert {c.optimizer.iterations for c in made} == {7}
    # Undisturbed once for all and four winds; three tracks, two seeds, two settings.
    assert len(sky.flown) == (1 + 4) * 3 * 2 * 2
    text, numbers = page(tmp_path, "randomisation")
    assert list(numbers["compared"]) == ["undisturbed", "wind", "all disturbances"]
    assert "| wind | 0 | 0 | +0 [+0, +0] |" in text and "shows no difference here" in text
    assert "| 3 | 3 | 0 | 0 | 0 | 0 |" in text and "| 5 | 3 | 0 | 0 | 0 | 0 |" in text
    assert reproduce(tmp_path, *args) == 0
    assert len(made) == 4 and len(sky.flown) == 60, "the second time all is there"


def test_a_trials_conditions_are_one_draw():
    # Twenty trials; the first ten are won by b alone, under each of five conditions.
    won = {"a": np.zeros((5, 20), bool), "b": np.tile(np.arange(20) < 10, (5, 1))}
    once, often = compare({name: each[:1] for name, each in won.items()}), compare(won)
    assert once["difference"] == often["difference"]
    assert often["difference"].value == 0.5
    assert often["difference"].low == pytest.approx(0.3, abs=0.06)
    assert often["b"].value == 0.5 and often["a"].value == 0


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--only", "linear_drag"], "linear_drag"),
        (["--training-seeds", "1", "1"], "--training-seeds is 1 1"),
        (["--iterations", "0"], "--iterations is 0"),
        (["--jobs", "99"], "--jobs is 99"),
    ],
)
def test_what_cannot_be_used_is_said_before_anything_is_trained(
    args, words, made, tmp_path, capsys
):
    assert reproduce(tmp_path, *ARGS, *args) == 2
    assert words in capsys.readouterr().err
    assert not made and not list(tmp_path.iterdir())
