"""The trainer's benchmark: its worlds, and how fast ours is."""

import numpy as np
import pytest

from suite.experiments.bench import train
from tracks.geometry.scene import PARKED_Z


def test_every_world_has_64_solids_where_the_drone_flies():
    worlds = train.bench_worlds(train.bench_config(6, 12))
    kinds = (worlds.scene.boxes, *worlds.scene[2:5])
    assert sum(part.center_w.shape[1] for part in kinds) == 64 == sum(train.SOLIDS)
    for part in kinds:
        assert np.all(part.center_w[..., 2] > PARKED_Z / 2)
        assert all(np.all(np.isfinite(array)) for array in part)


@pytest.mark.slow
def test_ours_is_at_least_two_and_a_half_times_as_fast():
    result = train.run()
    assert result.details["solids"] == 64
    if result.warnings:
        pytest.skip(result.warnings[0])
    assert result.ratio >= 2.5
