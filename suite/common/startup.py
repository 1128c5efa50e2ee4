"""Prepare a command's process: standard streams, environment variables of JAX, and file names.

This happens before other packages are imported, for two reasons. JAX reads its settings at import.
And a file that is opened while a standard stream is closed gets the number of that stream, so it
would receive the printed text.
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
from tracks.common.names import printable

KEPT_PREFIXES = (
    *("JAX_PLATFORM", "JAX_CUDA_", "JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_"),
    *("JAX_TRACEBACK_", "JAX_LOGGING_LEVEL"),
)
"""Prefixes of the environment variables of JAX that are kept: devices, caches and logging."""
DEBUG_SWITCHES = (
    *("JAX_DISABLE_JIT", "JAX_DEBUG_NANS", "JAX_DEBUG_INFS", "JAX_LOG_COMPILES"),
    *("JAX_EXPLAIN_CACHE_MISSES", "JAX_ENABLE_COMPILATION_CACHE", "JAX_CHECK_TRACER_LEAKS"),
    "JAX_DISABLE_MOST_OPTIMIZATIONS",
)
"""Environment variables of JAX for debugging that are kept if they are a switch (0 or 1)."""
FULL_PRECISION = ("JAX_DEFAULT_MATMUL_PRECISION", "highest")
"""Variable and value with which JAX multiplies matrices in unrounded float32. By default
accelerators use fewer bits, too few for a rotation."""
CACHE_WARNINGS = tuple(
    f"Error {action} persistent compilation cache" for action in ("reading", "writing")
)
"""Beginnings of JAX's warnings if its cache of compiled programs cannot be used."""
PACKAGES = tuple(
    Path(__file__).parents[2] / name for name in ("tracks", "policies", "eval", "suite")
)
"""Folders of the suite's code."""
_FORMAT = warnings.formatwarning


class _UnfailingStderr(io.FileIO):
    """Standard error that ignores a full disk or a missing reader, so that work continues."""

    def write(self, data: Any) -> int:
        with contextlib.suppress(OSError):
            written = super().write(data)
            if written is not None:
                return written
        return len(memoryview(data).cast("B"))


class _NamedStdout(io.FileIO):
    """Standard output; the message of a failed write has its name."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            error.filename = "standard output"
            raise


def open_streams() -> None:
    """Open the standard streams again so that they never fail in an unclear way.

    Missing streams become the null device. Characters outside the terminal's encoding are printed
    as escapes. Text that cannot be written to standard error is lost.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, which is this one
    sys.stdin = sys.stdin or open(0, encoding="utf-8", closefd=False)
    sys.stdout = _text_stream(_NamedStdout(1, "w", closefd=False), sys.stdout)
    sys.stderr = _text_stream(_UnfailingStderr(2, "w", closefd=False), sys.stderr)


def _text_stream(raw: io.FileIO, old: TextIO | None) -> TextIO:
    """Return a text stream on `raw`, with the encoding and the buffering of the stream `old`."""
    encoding = old.encoding if old else "utf-8"
    unbuffered = getattr(old, "write_through", False)  # python -u, PYTHONUNBUFFERED
    line_buffering = raw.isatty() or unbuffered or isinstance(raw, _UnfailingStderr)
    return io.TextIOWrapper(
        io.BufferedWriter(raw), encoding, "backslashreplace", line_buffering=line_buffering
    )


def suppress_warnings() -> None:
    """Suppress warnings that do not help the user, here and in worker processes.

    They are the runtime warnings of numpy, and the warnings of JAX about its cache of compiled
    programs. If the user has chosen which warnings are shown, all are shown as chosen. A warning of
    the suite is printed as one line, without the place in the code.
    """
    warnings.formatwarning = format_warning
    if not sys.warnoptions and "PYTHONWARNINGS" not in os.environ:
        warnings.simplefilter("ignore", RuntimeWarning)
        filters = ["ignore::RuntimeWarning"]
        for message in CACHE_WARNINGS:
            warnings.filterwarnings("ignore", message, UserWarning)
            filters.append(f"ignore:{message}:UserWarning")
        os.environ["PYTHONWARNINGS"] = ",".join(filters)


def format_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    """Return a warning of the suite as a line for the user, without the place in the code."""
    if category is UserWarning and any(map(Path(filename).is_relative_to, PACKAGES)):
        return f"warning: {printable(str(message))}\n"
    return _FORMAT(message, category, filename, lineno, line)


def check_names(args: Iterable[str]) -> None:
    """Refuse words of a command line that are not UTF-8 or begin with ~/.

    A result file could not store a word that is not UTF-8. A ~ that the shell did not replace would
    make a folder with this name.

    Raises:
        ValueError: for such a word.
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


def clean_jax_environment(environment: MutableMapping[str, str] | None = None) -> list[str]:
    """Remove environment variables of JAX that could change results or end the command.

    JAX has about a hundred variables, so the harmless ones are listed here (KEPT_PREFIXES and
    DEBUG_SWITCHES). FULL_PRECISION is set. The environment (by default that of this process) is
    changed in place.

    Returns:
        The names of the removed variables.
    """
    values = os.environ if environment is None else environment
    allowed = ("0", "1", "true", "false")
    switches = {name for name in DEBUG_SWITCHES if values.get(name, "0").lower() in allowed}
    removed = [
        name
        for name, value in values.items()
        if name.startswith("JAX_")
        and value
        and (name, value) != FULL_PRECISION
        and name not in switches
        and not name.startswith(KEPT_PREFIXES)
    ]
    for name in removed:
        del values[name]
    values.update([FULL_PRECISION])
    return sorted(removed)


def keep_compiled(environment: MutableMapping[str, str] | None = None) -> None:
    """Make JAX keep compiled programs in the user's cache, unless another folder is set.

    XLA, the compiler of JAX, needs 15 s for the model of a diagnosis and longer for a training. A
    second call of the same command reads the compiled programs. The environment (by default that of
    this process) is changed in place. An existing JAX_COMPILATION_CACHE_DIR, also an empty one, is
    not changed.
    """
    values = os.environ if environment is None else environment
    if "JAX_COMPILATION_CACHE_DIR" not in values:
        # Machines with a common home folder must not share machine code: their processors differ.
        folder = user_cache(values) / "jax" / (platform.node() or "here")
        values["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    if values["JAX_COMPILATION_CACHE_DIR"]:
        # A killed process leaves empty files. JAX does not replace them, so the programs would be
        # compiled again in every run.
        for entry in Path(values["JAX_COMPILATION_CACHE_DIR"]).glob("*-cache"):
            with contextlib.suppress(OSError):
                if not entry.stat().st_size:
                    entry.unlink()
    # XLA warns about its own tuning hints at every program that it loads; real errors are raised
    # as exceptions.
    values.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def use_device(device: str | None) -> None:
    """Make JAX compute on the CPU ("cpu") or on a GPU ("gpu"); None: on a GPU if it finds one.

    Raises:
        ValueError: if JAX cannot use a GPU.
    """
    if device is None:
        return
    import jax

    jax.config.update("jax_platforms", "cuda" if device == "gpu" else device)
    try:
        jax.devices()
    except (RuntimeError, AssertionError):  # which of them is raised depends on the driver
        raise ValueError(
            f"--device {device}: JAX finds none; leave --device out, or install JAX for your GPU: "
            "pip install 'diffracing-suite[cuda]'"
        ) from None
