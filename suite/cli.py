"""The command line: a table of subcommands, each imported only when it is called.

A command is a module with `Config`, a frozen dataclass whose fields become its options (the text
under a field is its help), and `run(config, console)`, which does the work and returns what --json
prints. If it has `config_of(args)`, this returns the configuration that the first word selects,
that word, and the other words.
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
from suite.common.startup import check_names, hush, keep_compiled, open_streams, pin
from suite.common.usage import (
    COMMANDS,
    JOINED,
    description,
    overview,
    renamed,
    with_lists,
)


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
        # Held until the process ends: with its frames would go what XLA's threads may still use.
        sys.last_value = error
        _complain("interrupted; what was finished is kept")
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our output has left: nothing to say, and no one to say it to.
        _output_fails()
        return FAILED
    except Exception as error:
        _output_fails()
        known = explain(error)
        if known is None:
            traceback.print_exc()
            _complain("this is a bug; please report the lines above and those of `suite info`")
            return FAILED
        code, message = known
        _complain(message)
        return code


def _output_fails() -> bool:
    """Say whether standard output takes nothing more; what it holds goes to the null device."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


def _dispatch(args: list[str]) -> int:
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
        ValueError: for an option that is given twice, and for a word that belongs to none.
        SystemExit: after --help (code 0), and for options that cannot be read (code 2).
    """
    from suite.common.options import options, read_options

    command = importlib.import_module(f"suite.commands.{name}")
    kind, prog = command.Config, f"suite {name}"
    if hasattr(command, "config_of"):
        kind, word, args = command.config_of(args)
        prog = f"{prog} {word}".rstrip()
    found = list(options(kind))
    listed, repeated = ({o.flag for o in found if getattr(o, f)} for f in ("listed", "repeated"))
    if any(option.positional for option in found):
        # A word behind an option may be a positional one.
        args = with_lists(args, listed)
    else:
        args = with_lists(args, listed, JOINED, repeated)
    _refuse_twice(args, repeated)
    about = description(name, kind.__doc__ or "")
    config, left = read_options(kind, prog, about, args)
    if left and not any(word.startswith("-") for word in left):
        raise ValueError(f"{left[0]!r} belongs to no option; {prog} --help lists them")
    if left:
        # Read again only to end with a message that lists similar options.
        read_options(kind, prog, about, args, all_known=True)
    return command, config


def _refuse_twice(args: Sequence[str], repeated: set[str]) -> None:
    """Refuse an option that is given twice: of two `--set` the first would be left out silently."""
    flags = [arg.partition("=")[0].replace("_", "-") for arg in args if arg.startswith("--")]
    twice = {flag for flag in flags if flags.count(flag) > 1}
    for flag in sorted(twice - repeated):
        raise ValueError(f"{flag} is given twice; give it once, with all its values behind it")


def _run(name: str, args: list[str]) -> int:
    from suite.common.console import Console, stdout_kept_clean
    from tracks.common.work.threads import one_thread_a_product, set_threads

    for variable in pin():
        _complain(f"{variable} of the environment is set aside: it might change results")
    args, notes = renamed(name, args)
    for note in notes:
        _complain(note)
    keep_compiled()
    os.environ["MPLBACKEND"] = "agg"  # charts become files; a notebook's backend may be missing
    set_threads()
    one_thread_a_product()
    try:
        command, config = parse(name, args)
    except SystemExit as stop:
        return int(stop.code or 0)

    from suite.common.running.lock import one_writer_each
    from tracks.input.ranges import check_ranges

    with stdout_kept_clean() if config.json else nullcontext():
        check_ranges(config, options=True)
        with one_writer_each(config.written()):
            answer = command.run(config, Console())
    if config.json:
        from tracks.common.files import to_json

        print(to_json(answer, indent=2), flush=True)
    return DONE


def _complain(message: str) -> None:
    from tracks.common.names import printable

    print(f"suite: {printable(message)}", file=sys.stderr)


def _without_working_folder() -> None:
    """Keep the working folder off the module path: its eval.py would stand for our package.

    That of processes of ours as well, which begin with Python's own socket.py.
    """
    os.environ["PYTHONSAFEPATH"] = "1"
    root = Path(__file__).resolve().parents[1]
    try:
        here = Path.cwd()
    except FileNotFoundError:  # removed meanwhile: what is relative to it is refused by its name
        return
    if here != root:
        sys.path[:] = [path for path in sys.path if path and Path(path).absolute() != here]


def entry() -> None:
    """Be the program `suite`."""
    _without_working_folder()
    from suite.common.running.hosts import several

    open_streams()
    hush()
    code = main()
    # Whoever leaves others early would wait for them, as for a cluster that does not answer.
    if code == INTERRUPTED or (code and (several() or "distributed" in sys.modules)):
        end_at_once(code)
    raise SystemExit(code)


if __name__ == "__main__":
    entry()
