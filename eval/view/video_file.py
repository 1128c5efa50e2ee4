"""Encode the frames of a video as a file: MP4 through ffmpeg, or GIF."""

from __future__ import annotations

import itertools
import subprocess
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from PIL import Image

COLOURS = 128
"""Number of colours in a GIF's palette."""


def write_mp4(
    path: Path,
    frames: Iterable[Image.Image],
    size: tuple[int, int],
    fps: int,
    on_frame: Callable[[int], None] | None = None,
) -> None:
    """Write frames as H.264 in MP4, through a pipe to ffmpeg.

    Only one frame is in memory at a time. `size` is width and height, even numbers [pixels].
    `on_frame` is called after each frame with the number of finished frames.

    Raises:
        OSError: where ffmpeg fails, with its message.
    """
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", str(fps)]
    # yuv420p plays in every browser; with the index in front a video plays while it loads.
    command += ["-i", "-", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "22"]
    command += ["-movflags", "+faststart", str(path)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=subprocess.DEVNULL, stderr=pipe) as encoder:
        assert encoder.stdin is not None and encoder.stderr is not None
        try:
            for number, frame in enumerate(frames, start=1):
                encoder.stdin.write(frame.tobytes())
                if on_frame is not None:
                    on_frame(number)
        except BrokenPipeError:
            pass  # the encoder has failed; its message is read below
        except BaseException:
            encoder.kill()
            raise
        finally:
            with suppress(BrokenPipeError):
                encoder.stdin.close()
        reason = encoder.stderr.read().decode(errors="replace").strip()
    if encoder.returncode:
        raise OSError(f"{path.name}: the video encoder failed: {reason}")


def write_gif(
    path: Path,
    frames: Iterable[Image.Image],
    fps: int,
    swatches: np.ndarray,
    on_frame: Callable[[int], None] | None = None,
) -> None:
    """Write frames as a GIF that loops, all with one palette.

    The palette has the colours `swatches` (n, 3), 0-255, in addition to those of the first frame.
    `on_frame` is called after each frame with the number of finished frames.
    """
    indexed: list[Image.Image] = []
    for number, frame in enumerate(frames, start=1):
        palette = indexed[0] if indexed else _palette(frame, swatches)
        # Without dithering, areas have one colour, which a GIF stores in few bytes.
        indexed.append(frame.quantize(palette=palette, dither=Image.Dither.NONE))
        if on_frame is not None:
            on_frame(number)
    # A GIF's durations are whole hundredths of a second, so they differ from frame to frame.
    ends = [10 * round(100 * number / fps) for number in range(len(indexed) + 1)]
    durations = [end - start for start, end in itertools.pairwise(ends)]
    indexed[0].save(path, save_all=True, append_images=indexed[1:], duration=durations, loop=0)


def _palette(frame: Image.Image, swatches: np.ndarray) -> Image.Image:
    """Return an image with a palette for `frame` and `swatches`, both with the same weight."""
    pixels = np.asarray(frame, dtype=np.uint8).reshape(-1, 3)
    repeats = max(1, len(pixels) // len(swatches))
    pixels = np.concatenate([pixels, np.repeat(swatches.astype(np.uint8), repeats, axis=0)])
    return Image.fromarray(pixels[None]).quantize(COLOURS)
