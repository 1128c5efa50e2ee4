"""The help texts of `suite` and its commands, and what happens to arguments before parsing."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Container, Sequence

GROUPS: dict[str, dict[str, str]] = {
    "Fly": {
        "eval": "judge policies: success rates, speeds and lap times, with intervals",
        "compare": "compare success rates of evaluations on the same trials, with a test",
        "view": "write a recording, pictures and a video of trials",
        "collect": "fly a policy and record every flight as a log",
        "fly": "fly a policy in real time over MAVLink, as a companion computer does",
    },
    "Train": {
        "train": "train a policy by backpropagation through quadrotors or a point mass",
        "delta": "fit a Delta Action Model, a network that corrects the action, to flights",
        "loop": "fly, find what the simulation lacks, fine-tune for it, fly again",
        "export": "write a policy as torch program, ONNX and C",
    },
    "Logs": {
        "import": "read a log of PX4, ArduPilot, Betaflight, a Crazyflie, ROS 2 or a table",
        "check": "find mistakes of unit, frame, sign and scale in logs, vehicle and policy files",
        "identify": "estimate the parameters of a vehicle file from flight logs",
        "diagnose": "name the physical effect that a vehicle file lacks, from flight logs",
        "example": "write example flights: with a hidden effect, or of a real quadrotor",
    },
    "Develop": {
        "list": "list tracks, vehicles, policies, recipes, effects, simulators, settings",
        "tracks": "describe the track families, or draw a track",
        "effects": "describe the physical effects that a vehicle file may hold",
        "reproduce": "make the published tables and charts",
        "blind": "test the diagnosis on cases with hidden effects: make, run, score",
        "bench": "compare the speed of a core function with a plain implementation",
        "completion": "print the shell completion for bash or zsh",
        "info": "print versions, devices, memory and commit, for bug reports",
    },
}
"""Group -> command -> one-line summary; the command NAME lives in suite/commands/NAME.py."""

COMMANDS: dict[str, str] = {
    name: summary for group in GROUPS.values() for name, summary in group.items()
}
"""Name of each command -> one-line summary."""

EXAMPLES: dict[str, tuple[str, ...]] = {
    "eval": (
        "suite eval --track ellipse --difficulty 9 --trials 50",
        "suite eval --policy race --policy mine.onnx --difficulty 0,3 --trials 100",
    ),
    "compare": ("suite compare runs/a runs/b", "suite compare runs/mine --against runs/race"),
    "view": (
        "suite view runs/eval --pick failed --video",
        "suite view race --track zigzag --difficulty 9 --seed 3 --gif",
    ),
    "collect": (
        "suite collect --track circular --difficulty 0 --trials 4 --out runs/flights",
        "suite collect --policy mine.onnx --vehicle mine.toml",
    ),
    "fly": (
        "suite fly --track zigzag --trials 20",
        "suite fly --link udpin:0.0.0.0:14540 --track course.toml --vehicle mine.toml --confirm",
    ),
    "train": (
        "suite train --out runs/mine",
        "suite train --recipe quick --iterations 100 --out runs/quick",
    ),
    "delta": (
        "suite delta runs/flights --out runs/delta",
        "suite delta runs/flights --model quad --vehicle racer5 --out runs/delta-quad",
    ),
    "loop": (
        "suite loop --policy race --out runs/loop",
        "suite loop --hidden-vehicle examples/hidden.toml --policy race-paper",
    ),
    "export": (
        "suite export --policy runs/mine/policy --out runs/export",
        "suite export --policy race --format c --out runs/c",
    ),
    "import": (
        "suite import flight.ulg --out flight.parquet",
        "suite import flight.csv --map mine.toml --out flight.parquet",
    ),
    "check": ("suite check flight.parquet --vehicle mine.toml", "suite check --policy mine.onnx"),
    "identify": (
        "suite identify flight.parquet --vehicle racer5 --out mine.toml",
        "suite identify logs/*.parquet --vehicle mine.toml --out better.toml",
    ),
    "diagnose": (
        "suite diagnose logs/*.parquet --vehicle mine.toml --out runs/diagnosis",
        "suite diagnose today/*.parquet --reference lastweek/*.parquet --vehicle mine.toml",
    ),
    "example": ("suite example --out example", "suite example --real --out real"),
    "list": ("suite list", "suite list policies"),
    "tracks": ("suite tracks", "suite tracks ellipse --difficulty 9 --seed 3"),
    "effects": ("suite effects", "suite effects linear_drag"),
    "reproduce": (
        "suite reproduce status --out docs/results",
        "suite reproduce table2 --out docs/results",
    ),
    "blind": ("suite blind make --out runs/blind", "suite blind run --out runs/blind"),
    "bench": ("suite bench", "suite bench train"),
    "completion": ("suite completion bash", "suite completion zsh"),
    "info": ("suite info", "suite info --json"),
}
"""Command -> examples that its help begins with."""

JOINED = ("--track", "--difficulty")
"""Options that read a list as one word with commas, such as `--track ellipse,zigzag`."""


def overview() -> str:
    """Return the text of `suite --help`."""
    width = max(map(len, COMMANDS))
    lines = [
        "usage: suite COMMAND [options]",
        "",
        "Train drone racing policies through differentiable dynamics, judge them in MuJoCo, and",
        "find out where simulation and flight logs disagree.",
    ]
    for title, commands in GROUPS.items():
        lines += ["", f"{title}:"]
        lines += [f"  {name:<{width}}  {summary}" for name, summary in commands.items()]
    lines += [
        "",
        "Examples:",
        "  suite eval --track ellipse --difficulty 9",
        "  suite train --out runs/mine",
        "  suite diagnose logs/*.parquet --vehicle mine.toml --out runs/diagnosis",
        "",
        "suite COMMAND --help lists a command's options; suite --version prints the version.",
    ]
    return "\n".join(lines)


def first_paragraph(text: str | None) -> str:
    """Return the first paragraph of a docstring as one line."""
    return " ".join((text or "").split("\n\n")[0].split())


def description(name: str, about: str) -> str:
    """Return the beginning of a command's help: its purpose, its examples, then further notes.

    The first paragraph of `about` is the purpose, the others are notes.
    """
    purpose, *paragraphs = [" ".join(part.split()) for part in about.split("\n\n")]
    # A line that begins with a space keeps its break; others are joined, and not wrapped.
    notes = [
        line for part in paragraphs for line in textwrap.wrap(part, 76, break_on_hyphens=False)
    ]
    sections = {"Examples": EXAMPLES.get(name, ()), "Notes": notes}
    texts = ["\n  ".join([f"{title}:", *lines]) for title, lines in sections.items() if lines]
    return "\n\n".join([purpose, *texts])


def with_lists(
    args: Sequence[str],
    listed: Container[str],
    joined: Container[str] = (),
    repeated: Container[str] = (),
) -> list[str]:
    """Return `args` with each list in the form that its option reads.

    The user may separate the entries of a list by commas or by spaces. A word with "=" keeps its
    commas: they are within a value, as in `--set fov_deg=87,58`.

    Args:
        args: the words of a command line.
        listed: options that read one word for each value: `--speed 0.3,1` becomes `--speed 0.3 1`.
        joined: options that read one word for all: `--track a b` becomes `--track a,b`.
        repeated: options that are repeated for each value: `--policy a b`, which a shell makes of
            `--policy runs/*`, becomes `--policy a --policy b`.
    """
    out, option, count = list[str](), "", 0
    for word in args:
        flag, equal, value = word.partition("=")
        if word.startswith("--") or (word.startswith("-") and option not in listed):
            option, count = flag, int(bool(equal))
            out += [flag, *value.split(",")] if equal and option in listed else [word]
            continue
        count += 1
        if option in listed:
            out += [word] if equal else word.split(",")
        elif count > 1 and option in joined:
            out[-1] += f",{word}"
        else:
            out += [option, word] if count > 1 and option in repeated else [word]
    return out


def _simulator(value: str) -> list[str]:
    return ["--simulator", value]


def _hidden_vehicle(value: str) -> list[str]:
    """Return the options for `suite loop --world`, whose value was SIMULATOR, FILE or both."""
    from eval.worlds import WORLDS

    simulator, _, vehicle = value.partition(":")
    if simulator not in WORLDS:
        return ["--hidden-vehicle", value]
    return ["--simulator", simulator, *(["--hidden-vehicle", vehicle] if vehicle else [])]


RENAMED: dict[str, dict[str, Callable[[str], list[str]]]] = {
    "eval": {"--world": _simulator},
    "collect": {"--world": _simulator},
    "reproduce": {"--world": _simulator},
    "loop": {"--world": _hidden_vehicle},
}
"""Command -> option of an earlier version -> function (value) -> words that replace the option.
Version 0.2 removes these options."""


def renamed(name: str, args: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return `args` with options of earlier versions replaced, and a note for each of them."""
    replacements, out, notes = RENAMED.get(name, {}), list[str](), list[str]()
    words = iter(args)
    for word in words:
        option, _, value = word.partition("=")
        if option not in replacements:
            out.append(word)
            continue
        replacement = replacements[option](value or next(words, ""))
        out += replacement
        notes.append(f"{option} is now {' '.join(replacement)}; version 0.2 removes {option}")
    return out, notes
