"""What a video shows, and that it plays every frame and leaves nothing where it fails."""

import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image, ImageSequence

from eval.view import colours
from eval.view.chase import _not_between
from eval.view.video import DEPTH_RANGE_M, VideoOptions, frame_times, video_frames, write_video
from eval.view.video_file import write_gif
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
    assert _not_between(faces, eye, drone).tolist() == [False, True, True]


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


SMALL = VideoOptions(size=(160, 96), fps=10, hold_s=0.3)


@pytest.mark.parametrize("kind", ["mp4", "gif"])
def test_a_video_plays_the_whole_flight(tmp_path, kind):
    done = []
    path = tmp_path / f"a.{kind}"
    track, flight, result = rollout()
    write_video(path, track, flight, result, SMALL, done.append)
    expected = len(frame_times(flight, SMALL))
    assert done == list(range(1, expected + 1))
    assert abs(expected / SMALL.fps - flight.time_s[-1] - SMALL.hold_s) < 0.11
    if kind == "gif":
        with Image.open(path) as video:
            assert video.size == SMALL.size
            # Frames that are alike are one that stays longer.
            lasting = sum(frame.info["duration"] for frame in ImageSequence.Iterator(video))
        assert lasting == expected * 1000 / SMALL.fps
        return
    decoder = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-i",
        path,
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    done = subprocess.run(decoder, capture_output=True, check=True)
    stream = done.stderr.decode().split("Output #0")[0]
    assert "h264" in stream and "yuv420p" in stream and "160x96" in stream and "10 fps" in stream
    frames = np.frombuffer(done.stdout, np.uint8).reshape(-1, 96, 160, 3)
    assert len(frames) == expected
    painted = list(video_frames(track, flight, result, SMALL))
    for number in (0, expected // 2, expected - 1):
        error = np.abs(frames[number].astype(int) - np.asarray(painted[number]).astype(int))
        assert error.mean() < 6


def test_a_gif_is_as_long_as_its_frames_at_any_rate(tmp_path):
    frames = [Image.new("RGB", (8, 8), (20 * k, 0, 0)) for k in range(12)]
    write_gif(tmp_path / "a.gif", frames, 12)
    with Image.open(tmp_path / "a.gif") as video:
        lasting = [frame.info["duration"] for frame in ImageSequence.Iterator(video)]
    assert sum(lasting) == 1000


def test_a_video_that_fails_or_is_interrupted_leaves_nothing(tmp_path, monkeypatch):
    def interrupt(number):
        raise KeyboardInterrupt

    for kind in ("mp4", "gif"):
        with pytest.raises(KeyboardInterrupt):
            write_video(tmp_path / f"a.{kind}", *rollout(), SMALL, interrupt)
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: "false")
    with pytest.raises(OSError, match=r"a\.mp4: the video encoder failed"):
        write_video(tmp_path / "a.mp4", *rollout(), SMALL)
    assert not list(tmp_path.iterdir())
