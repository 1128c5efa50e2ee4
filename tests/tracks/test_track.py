"""A track is cut to its first gates, its obstacles kept."""

import numpy as np
import pytest

from tracks.families import make_track
from tracks.geometry.scene import counts
from tracks.track import first_gates


@pytest.mark.parametrize("count", [1, 4, 8])
def test_the_first_gates_of_a_track(count):
    track = make_track("random", 7, 3)
    short = first_gates(track, count)
    for field, whole in zip(short.scene.gates, track.scene.gates, strict=True):
        np.testing.assert_array_equal(field, whole[:count])
    have, had = counts(short.scene), counts(track.scene)
    assert had.boxes - have.boxes == 4 * (8 - count) and have[1:] == had[1:]
    boxes = short.scene.boxes.center_w
    np.testing.assert_array_equal(boxes[: 4 * count], track.scene.boxes.center_w[: 4 * count])
    np.testing.assert_array_equal(boxes[4 * count :], track.scene.boxes.center_w[32:])
    assert len(short.names) == sum(have) and "gate 0 frame" in short.names[0]
    assert short.names[4 * count :] == track.names[32:]


@pytest.mark.parametrize("count", [0, 9])
def test_more_gates_than_there_are_or_none(count):
    with pytest.raises(ValueError, match=f"{count} gates of a track that has 8"):
        first_gates(make_track("random", 0, 0), count)
