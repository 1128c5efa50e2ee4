"""Encode the frames of a video as a file, MP4 or GIF, by ffmpeg."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import imageio_ffmpeg
from PIL import Image

ENCODING = {
    # yuv420p plays in every browser; with the index in front a video plays while it loads.
    ".mp4": "-c:v libx264 -pix_fmt yuv420p -crf 22 -movflags +faststart".split(),
    # One palette for all frames. Without dithering, areas have one colour, which takes few bytes.
    ".gif": [
        "-filter_complex",
        "split[a][b];[a]palettegen=max_colors=128[palette];[b][palette]paletteuse=dither=none",
    ],
}
"""Ending of a video file -> options of ffmpeg for this format: H.264, or a GIF that loops."""


def write_video_file(
    path: Path,
    frames: Iterable[Image.Image],
    size: tuple[int, int],
    fps: int,
    on_frame: Callable[[int], None] | None = None,
) -> None:
    """Write frames in the format of the ending of `path`, through a pipe to ffmpeg.

    `size` is width and height, even numbers [pixels]. `on_frame` is called after each frame with
    the number of finished frames.

    Raises:
        OSError: where ffmpeg fails, with its message.
    """
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", str(fps)]
    command += ["-i", "-", *ENCODING[path.suffix.lower()], str(path)]
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
