"""Encoded videos play every frame, and leave nothing where they fail."""

import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image, ImageSequence

from eval.view.video import (
    VideoOptions,
    frame_times,
    video_frames,
    write_video,
)
from eval.view.video_file import write_gif
from tests.support.flights import rollout

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
