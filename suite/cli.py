"""The program `suite`: reads the command line, runs a command and returns its exit code.

A command NAME is the module suite/commands/NAME.py, imported only when it is called. It has
`Config`, a frozen dataclass whose fields become its options (the text under a field is its help),
and `run(config, console)`, which does the work and returns the object that --json prints; it raises
a ValueError for options that cannot be used. If it has `config_of(args)`, this returns the
configuration that the first word selects, that word, and the other words.
"""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType
from typing import Any

from suite.common.errors import DONE, FAILED, INTERRUPTED, UNUSABLE, explain
from suite.common.running.interrupts import end_at_once, ends_in_seconds
from suite.common.startup import (
    check_names,
    clean_jax_environment,
    keep_compiled,
    open_streams,
    suppress_warnings,
)
from suite.common.usage import COMMANDS, JOINED, description, overview, renamed, with_lists


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line (`argv` without the program's name) and return the exit code."""
    args = list(sys.argv[1:] if argv is None else argv)
    try:
        with ends_in_seconds():
            check_names(args)
            code = _dispatch(args)
            sys.stdout.flush()
            return code
    except KeyboardInterrupt as error:
        # Kept until the process ends: XLA's threads may still use data of the error's frames.
        sys.last_value = error
        _print_message("interrupted; the same command continues from saved work, if there is some")
        return INTERRUPTED
    except BrokenPipeError:
        # Nobody reads the output any more, so no message is printed.
        _drop_unwritable_output()
        return FAILED
    except Exception as error:
        _drop_unwritable_output()
        explanation = explain(error)
        if explanation is None:
            traceback.print_exc()
            _print_message("this is a bug; please report the lines above and those of `suite info`")
            return FAILED
        code, message = explanation
        _print_message(message)
        return code


def _drop_unwritable_output() -> None:
    """Send buffered text that standard output does not accept to the null device."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _dispatch(args: list[str]) -> int:
    """Print the general help or the version, or run the command that the first word names."""
    if args[:1] == ["help"]:
        args = [*args[1:2], "--help"]
    if not args or args[0] in ("-h", "--help"):
        print(overview(), file=sys.stdout if args else sys.stderr)
        return DONE if args else UNUSABLE
    if args[0] == "--version":
        from tracks.common.provenance import VERSION

        print(f"suite {VERSION}")
        return DONE
    name, *rest = args
    if name.startswith("-"):
        raise ValueError(f"{name}: options come after a command: suite eval {name}")
    if name not in COMMANDS:
        from tracks.common.names import unknown_name

        raise unknown_name("command", name, COMMANDS)
    return _run(name, rest)


def parse(name: str, args: Sequence[str]) -> tuple[ModuleType, Any]:
    """Return the module of the command `name` and its configuration from `args`.

    Raises:
        ValueError: for an option that is given twice, a word that is empty, and one that belongs to
            no option.
        SystemExit: after --help (code 0), and for options that cannot be read (code 2).
    """
    from suite.common.options import options, read_options

    for before, word in zip([name, *args], args, strict=False):
        # An empty path would be the current folder.
        if word == "" or (word.startswith("--") and word.endswith("=")):
            where = word or f"{before} ''"
            raise ValueError(
                f"{where}: the value is empty; perhaps a variable of the shell is not set"
            )
    command = importlib.import_module(f"suite.commands.{name}")
    kind, prog = command.Config, f"suite {name}"
    if hasattr(command, "config_of"):
        kind, word, args = command.config_of(args)
        prog = f"{prog} {word}".rstrip()
    all_options = list(options(kind))
    listed = {option.flag for option in all_options if option.listed}
    repeated = {option.flag for option in all_options if option.repeated}
    if any(option.positional for option in all_options):
        # A word after an option's value may be a positional one.
        args = with_lists(args, listed)
    else:
        args = with_lists(args, listed, JOINED, repeated)
    _refuse_repetition(args, repeated)
    about = description(name, kind.__doc__ or "")
    config, unknown = read_options(kind, prog, about, args)
    if unknown and not any(word.startswith("-") for word in unknown):
        raise ValueError(f"{unknown[0]!r} belongs to no option; {prog} --help lists them")
    if unknown:
        # Read again only to end with a message that lists similar options.
        read_options(kind, prog, about, args, all_known=True)
    return command, config


def _refuse_repetition(args: Sequence[str], repeated: set[str]) -> None:
    """Refuse an option that is given twice: the first of two `--set` would be ignored silently."""
    flags = [arg.partition("=")[0].replace("_", "-") for arg in args if arg.startswith("--")]
    twice = {flag for flag in flags if flags.count(flag) > 1}
    for flag in sorted(twice - repeated):
        raise ValueError(f"{flag} is given twice; give it once; several values follow one another")


def _run(name: str, args: list[str]) -> int:
    """Run a command with its output folders locked, print its answer under --json; return 0."""
    from suite.common.console import Console, stdout_kept_clean
    from tracks.common.work.threads import one_thread_a_product, set_threads

    for variable in clean_jax_environment():
        _print_message(f"{variable} of the environment is ignored: it might change results")
    args, notes = renamed(name, args)
    for note in notes:
        _print_message(note)
    keep_compiled()
    os.environ["MPLBACKEND"] = "agg"  # charts become files; a notebook's backend may be missing
    set_threads()
    one_thread_a_product()
    try:
        command, config = parse(name, args)
    except SystemExit as stop:
        return int(stop.code or 0)

    from suite.common.running.lock import one_writer_each
    from suite.common.vehicles import warn_of_vehicles
    from tracks.input.ranges import check_ranges

    with stdout_kept_clean() if config.json else nullcontext():
        check_ranges(config, options=True)
        with one_writer_each(config.written()):
            warn_of_vehicles(name, config, Console())
            answer = command.run(config, Console())
    if config.json:
        from tracks.common.files import to_json

        print(to_json(answer, indent=2), flush=True)
    return DONE


def _print_message(message: str) -> None:
    """Print a message on standard error."""
    from tracks.common.names import printable

    print(f"suite: {printable(message)}", file=sys.stderr)


def _without_working_folder() -> None:
    """Remove the working folder from the module path, here and in worker processes.

    A user's file eval.py in it would be imported instead of our package.
    """
    os.environ["PYTHONSAFEPATH"] = "1"
    root = Path(__file__).resolve().parents[1]
    try:
        folder = Path.cwd()
    except FileNotFoundError:  # it was removed; relative paths give an error that names them
        return
    if folder != root:
        sys.path[:] = [path for path in sys.path if path and Path(path).absolute() != folder]


def entry() -> None:
    """Run the program `suite`, and end the process with its exit code."""
    _without_working_folder()
    from suite.common.running.hosts import is_distributed

    open_streams()
    suppress_warnings()
    code = main()
    # A normal exit would wait for the other processes, or for a cluster that does not answer.
    if code == INTERRUPTED or (code and (is_distributed() or "distributed" in sys.modules)):
        end_at_once(code)
    raise SystemExit(code)


if __name__ == "__main__":
    entry()
