"""A run's configuration is a value, and what no training can be made with is refused."""

from dataclasses import replace

import pytest

from suite.common.console import Console
from suite.train.config import check
from suite.train.presets import PRESETS, preset
from suite.train.run import train
from tests.support.training import small_config


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"height_spread": -1.0}, "episode.height_spread is -1.0, allowed is 0 to 100"),
        ({"height_spread": float("nan")}, "episode.height_spread is nan"),
        ({"batch": 0}, "episode.batch is 0, allowed is 1 to 1000000"),
        ({"stop_from": 1.5}, "episode.stop_from is 1.5, allowed is 0 to 1"),
        ({"gates": 9}, "episode.gates is 9, allowed is 1 to 8"),
        ({"difficulty": (0.5, 0.2)}, "episode.difficulty is .*lower end of the range first"),
        ({"physics": {"action_delay": (0.0, 3.0)}}, "physics.action_delay is .*allowed is 0 to 2"),
        ({"steps": 6, "image_stride": 4}, "image_stride is 4, allowed are divisors .*6"),
        ({"seed": -1}, "seed is -1, allowed is 0 to 4294967295"),
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


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_within_the_limits(name):
    check(preset(name))
