"""What a command finds when it starts: streams, environment variables and names, made usable.

One place, before anything slow is imported: JAX reads its settings when it is imported, and a file
that takes the number of a closed stream would get what is printed.
"""

from __future__ import annotations

import contextlib
import io
import os
import platform
import sys
import warnings
from collections.abc import Iterable, MutableMapping
from pathlib import Path
from typing import Any, TextIO

from tracks.common.files import user_cache

KEPT = (
    *("JAX_PLATFORM", "JAX_CUDA_", "JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_"),
    *("JAX_TRACEBACK_", "JAX_LOGGING_LEVEL"),
)
"""Beginnings of the variables of JAX that say where work runs, what is kept, and what is logged."""
SWITCHES = (
    *("JAX_DISABLE_JIT", "JAX_DEBUG_NANS", "JAX_DEBUG_INFS", "JAX_LOG_COMPILES"),
    *("JAX_EXPLAIN_CACHE_MISSES", "JAX_ENABLE_COMPILATION_CACHE", "JAX_CHECK_TRACER_LEAKS"),
    "JAX_DISABLE_MOST_OPTIMIZATIONS",
)
"""Those for people who look for a mistake; 0 or 1."""
PRECISE = ("JAX_DEFAULT_MATMUL_PRECISION", "highest")
"""Unrounded float32: accelerators multiply with fewer bits by default, too few for a rotation."""
UNKEPT = tuple(f"Error {what} persistent compilation cache" for what in ("reading", "writing"))
"""Beginnings of what JAX says where it cannot keep a program: it compiles that anew."""


class _Unfailing(io.FileIO):
    """Standard error on a full disk or without a reader: a line is lost, and no work with it."""

    def write(self, data: Any) -> int:
        with contextlib.suppress(OSError):
            written = super().write(data)
            if written is not None:
                return written
        return len(memoryview(data).cast("B"))


class _Named(io.FileIO):
    """Standard output: an error of writing names it, as one of a file names that."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            error.filename = "standard output"
            raise


def open_streams() -> None:
    """Give a process without standard input, output or error the null device in its place.

    What cannot be printed in the terminal's encoding is printed as an escape; what cannot be
    written to standard error is lost.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
    sys.stdin = sys.stdin or open(0, encoding="utf-8", closefd=False)
    sys.stdout = _text(_Named(1, "w", closefd=False), sys.stdout)
    sys.stderr = _text(_Unfailing(2, "w", closefd=False), sys.stderr)


def _text(raw: io.FileIO, old: TextIO | None) -> TextIO:
    encoding = old.encoding if old else "utf-8"
    lines = raw.isatty() or isinstance(raw, _Unfailing)
    return io.TextIOWrapper(
        io.BufferedWriter(raw), encoding, "backslashreplace", line_buffering=lines
    )


def hush() -> None:
    """Leave warnings out that are not for people, here and in processes of ours.

    They are numpy's, as errors have lines of their own, and JAX's of a cache that is full or cut.
    """
    if not sys.warnoptions and "PYTHONWARNINGS" not in os.environ:
        warnings.simplefilter("ignore", RuntimeWarning)
        for cache in UNKEPT:
            warnings.filterwarnings("ignore", cache, UserWarning)
        found = ["ignore::RuntimeWarning", *(f"ignore:{cache}:UserWarning" for cache in UNKEPT)]
        os.environ["PYTHONWARNINGS"] = ",".join(found)


def check_names(args: Iterable[str]) -> None:
    """Refuse words of a command line that no result file could name, and folders called ~.

    Raises:
        ValueError: for one that is not UTF-8, or holds a ~ that the shell left.
    """
    for arg in args:
        if arg.partition("=")[2].startswith("~/") or arg.startswith("~/"):
            raise ValueError(f"{arg!r}: the shell has not replaced ~ here; write $HOME for it")
        try:
            arg.encode()
        except UnicodeEncodeError:
            encoding = sys.getfilesystemencoding()
            if encoding != "utf-8":
                raise ValueError(
                    f"{arg!r} cannot be read, since the locale's encoding is {encoding}; set "
                    "LC_ALL to a UTF-8 locale such as C.UTF-8, and PYTHONUTF8 not to 0"
                ) from None
            raise ValueError(
                f"{arg!r} is not UTF-8, so result files cannot name it; rename the file or folder"
            ) from None


def pin(environment: MutableMapping[str, str] | None = None) -> list[str]:
    """Set aside variables of JAX that might change what is computed or end the command, in place.

    JAX has a hundred of them, so those are listed that do not. Products of matrices are computed
    in full precision.

    Returns:
        Their names.
    """
    values = os.environ if environment is None else environment
    known = ("0", "1", "true", "false")
    fine = {name for name in SWITCHES if values.get(name, "0").lower() in known}
    found = [
        name
        for name, value in values.items()
        if name.startswith("JAX_") and value and (name, value) != PRECISE
    ]
    aside = [name for name in found if name not in fine and not name.startswith(KEPT)]
    for name in aside:
        del values[name]
    values.update([PRECISE])
    return sorted(aside)


def keep_compiled(environment: MutableMapping[str, str] | None = None) -> None:
    """Have JAX keep compiled programs in the user's cache, where nothing else was asked for.

    XLA takes 15 s over the model of a diagnosis and longer over a trainer; a second call of the
    same command reads what the first one compiled.

    Args:
        environment: changed in place; that of this process if not given. A
            JAX_COMPILATION_CACHE_DIR that is there, also an empty one, is left as it is.
    """
    values = os.environ if environment is None else environment
    if "JAX_COMPILATION_CACHE_DIR" not in values:
        # A home that machines share must not hand one's instructions to another.
        folder = user_cache(values) / "jax" / (platform.node() or "here")
        values["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    if values["JAX_COMPILATION_CACHE_DIR"]:
        drop_cut_entries(Path(values["JAX_COMPILATION_CACHE_DIR"]))
    # XLA complains of its own tuning hints, which are no processor feature, at every program that
    # it loads; what goes wrong in earnest is raised as an exception.
    values.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def use_device(device: str | None) -> None:
    """Have JAX compute on the CPU ("cpu") or on a GPU ("gpu"); None: a GPU where it finds one.

    Raises:
        ValueError: where JAX cannot use a GPU.
    """
    if device is None:
        return
    import jax

    jax.config.update("jax_platforms", "cuda" if device == "gpu" else device)
    try:
        jax.devices()
    except (RuntimeError, AssertionError):  # which one depends on whether a driver is there
        raise ValueError(
            f"--device {device}: JAX finds none; leave --device out, or install JAX for your GPU: "
            "pip install 'jax[cuda12]'"
        ) from None


def drop_cut_entries(folder: Path) -> None:
    """Remove compiled programs of which a kill left no more than the name: JAX keeps such a one."""
    for entry in folder.glob("*-cache"):
        with contextlib.suppress(OSError):
            if not entry.stat().st_size:
                entry.unlink()
