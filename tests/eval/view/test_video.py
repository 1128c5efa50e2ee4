"""What a video shows, before it is encoded."""

import numpy as np
import pytest

from eval.view import colours
from eval.view.video import (
    DEPTH_RANGE_M,
    VideoOptions,
    _beyond,
    video_frames,
    write_video,
)
from tests.support.flights import rollout
from tests.support.pixels import share


def test_the_video_shows_drone_depth_and_gates():
    track, flight, result = rollout()
    frames = list(video_frames(track, flight, result, VideoOptions((480, 270), 5, hold_s=0.2)))
    assert share(frames[0], colours.AHEAD, 50) > 3e-3
    assert share(frames[0], colours.DRONE, 12) > 5e-4
    assert share(frames[-1], colours.PASSED, 2) > 5e-4  # the word at the end
    greens = []
    for frame in frames[:-1]:
        red, green, blue = np.moveaxis(np.asarray(frame, dtype=int)[100:, :320], -1, 0)
        greens.append(((green > 1.5 * red) & (green > 1.2 * blue)).mean())
    # No gate is green before it was passed; just behind it the eye sees it green.
    assert greens[0] == 0 < max(greens[2:])
    # Beside it, in the right third and at its middle: what it saw, pixel for pixel.
    seen = np.asarray(frames[0])[75:195, 320:480]
    assert flight.depth_m is not None
    want = colours.depth_colours(flight.depth_m[0], DEPTH_RANGE_M)
    np.testing.assert_array_equal(seen[2::5, 2::5], want)
    without = next(video_frames(*rollout("finished", None, False), VideoOptions((480, 270), 5)))
    assert share(without.crop((320, 0, 480, 270)), colours.DRONE, 2) < 0.01  # the scene goes on


def test_what_stands_before_the_drone_is_not_painted():
    eye, drone = np.zeros(3), np.array([2.0, 0.0, 0.0])
    before = np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 0.0, 1.0]])
    faces = np.stack([before, before + [2.0, 0.0, 0.0], before * [3.0, 1.0, 1.0] - [1.5, 0, 0]])
    faces[2, 0, 0] = 2.5  # one corner beyond is enough
    assert _beyond(faces, eye, drone).tolist() == [False, True, True]


def test_bad_video_requests_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"\.avi.*\.mp4 or \.gif"):
        write_video(tmp_path / "a.avi", *rollout())
    with pytest.raises(ValueError, match="even"):
        write_video(tmp_path / "a.mp4", *rollout(), VideoOptions(size=(161, 96)))
    track, flight, result = rollout()
    alone = flight._replace(time_s=np.zeros(1))
    with pytest.raises(ValueError, match="1 usable rows"):
        write_video(tmp_path / "a.mp4", track, alone, result)
    assert not list(tmp_path.iterdir())
