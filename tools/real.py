"""Real flights of three laboratories: what identify and diagnose make of them, as a page.

    python tools/real.py LOGS OUT

LOGS holds `nanobench`, `crazypad` and `crazyswarm2` with the authors' files (docs/results/real.md
says where they come from). Flights, vehicle files and diagnoses go to OUT, and `OUT/real.md`.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from suite.cli import main

FITTED = ("B10_lissajous_fast_rep1", "B2_circle_fast_rep2", "B3_figure8_fast_rep1",
          "B3_figure8_slow_rep2")  # fmt: skip
"""Flights of nanobench that make the vehicle file; the others are diagnosed."""
MASSES = {
    "upgraded": (
        ("log10", "log12"),
        ("log20", "log50", "log60", "log99", "log100", "log104", "log110"),
    ),
    "standard": (("log150", "log155"), ("log160", "log170", "log180")),
}
"""Flights of crazyswarm2 by motors: reference, and those compared with them."""


def suite(*words: Any) -> dict[str, Any]:
    """Run a command with `--json` and return what it says.

    Raises:
        RuntimeError: where it does not end well, with what it said.
    """
    said, wrong = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(wrong):
        code = main([*map(str, words), "--json"])
    if code:
        raise RuntimeError(f"suite {' '.join(map(str, words))}: {wrong.getvalue()[-500:]}")
    return json.loads(said.getvalue())


def imported(files: Iterable[Path], folder: Path, *options: Any) -> dict[str, Path]:
    """Return the flights of `files` in `folder` by name, imported where they are not there yet."""
    found = {}
    for file in sorted(files):
        found[file.stem] = folder / f"{file.stem}.parquet"
        if not found[file.stem].is_file():
            folder.mkdir(parents=True, exist_ok=True)
            options_of = (*options, "--vehicle", "crazyflie21", "--rate", 100)
            suite("import", file, "--out", found[file.stem], *options_of)
    return found


def names_of(found: dict[str, Any]) -> str:
    """Return the names of a diagnosis with their numbers, in a line."""
    named = []
    for effect in found["effects"]:
        sizes = []
        for key, entry in effect["parameters"].items():
            values = entry["value"] if isinstance(entry["value"], list) else [entry["value"]]
            shown = ", ".join("–" if v is None else f"{v:.3g}" for v in values)
            sizes.append(shown if key == "index" else f"{shown} {entry['unit']}".removesuffix(" 1"))
        or_else = "".join(f" or {name}" for name in effect["alternatives"])
        named.append(f"{effect['name']}{or_else} ({'; '.join(sizes)})")
    return "; ".join(named) or "–"


def nanobench(logs: Path, out: Path, *options: Any) -> list[str]:
    """Return the lines on nanobench: what is diagnosed with and without the drag it shows."""
    flights = imported(logs.glob("*.csv"), out / "flights", "--map", "nanobench", *options)
    given = [flights[name] for name in FITTED]
    others = [path for name, path in flights.items() if name not in FITTED]
    vehicle, bare = out / "identified.toml", out / "without_drag.toml"
    numbers = suite("identify", *given, "--vehicle", "crazyflie21", "--out", vehicle)["parameters"]
    whole = load_vehicle(str(vehicle))
    effects = {name: values for name, values in whole.effects.items() if "drag" not in name}
    save_vehicle(replace(whole, effects=MappingProxyType(effects)), bare, "without its drag")
    lines = [
        f"Vehicle file from {', '.join(FITTED)}; diagnosed: "
        f"{', '.join(sorted(path.stem for path in others))}.",
        "",
        "| vehicle file | named | verdict | "
        "force x, y: share of variance explained (black box) | seconds |",
        "|---|---|---|---|---|",
    ]
    for label, file in (("identified, its drag left out", bare), ("identified", vehicle)):
        found = suite("diagnose", *others, "--vehicle", file, "--out", out / file.stem)
        force = found["gap"]["channels"].get("force", {})
        shares = ", ".join(
            f"{100 * force[a]['closed']:.0f} ({100 * force[a]['explainable']:.0f}) %"
            for a in "xy"
            if a in force
        )
        lines.append(
            f"| {label} | {names_of(found)} | {found['verdict']} | {shares or '–'} "
            f"| {found['seconds']:.0f} |"
        )
    lines += ["", "| identified | value | 95 % interval | unit |", "|---|---|---|---|"]
    for key, entry in numbers.items():
        several = isinstance(entry["value"], list)
        values, spans = (entry[k] if several else [entry[k]] for k in ("value", "ci95"))
        shown = [", ".join(f"{v:.3g}" for v in values)]
        shown += [", ".join(f"{s[0]:.3g} to {s[1]:.3g}" if s else "–" for s in spans)]
        lines.append(f"| {key} | {' | '.join(shown)} | {entry['unit']} |")
    return lines


def changed(out: Path, references: Sequence[Path], flights: Sequence[Path]) -> str:
    """Return what is named of `flights`, compared with `references`, in a line."""
    before = [one for one in references if one not in flights]
    if len(before) < 2:
        return "too few references"
    found = suite("diagnose", *flights, "--reference", *before, "--vehicle", "crazyflie21",
                  "--out", out)  # fmt: skip
    return names_of(found)


def crazypad(logs: Path, out: Path, *options: Any) -> list[str]:
    """Return the lines on crazypad: each condition's flights together, and each flight alone.

    Without a pose only the controller logs hold something to diagnose: the rates.
    """
    lines = [
        "| logs, vehicle | condition | all flights together | each alone |",
        "|---|---|---|---|",
    ]
    for kind in ("controller",) if options else ("motor", "controller"):
        folder = out / kind
        flights = imported((logs / kind).iterdir(), folder / "flights", "--map", "crazypad",
                           "--partial", *options)  # fmt: skip
        for vehicle in ("E8", "E9"):
            own = {n: path for n, path in flights.items() if f"__{vehicle}_" in n}
            normal = [path for name, path in own.items() if name.startswith("normal")]
            for condition in sorted({name.split("__")[0] for name in own}):
                there = [path for name, path in own.items() if name.startswith(f"{condition}__")]
                whole = "–" if condition == "normal_flight" else changed(
                    folder / f"{condition}__{vehicle}", normal, there)  # fmt: skip
                alone = [changed(folder / path.stem, normal, [path]) for path in there]
                lines.append(
                    f"| {kind}, {vehicle} | {condition} | {whole} | {'<br>'.join(alone)} |"
                )
    return lines


def crazyswarm2(logs: Path, out: Path) -> list[str]:
    """Return the lines on crazyswarm2: flights of one mass together."""
    masses = {
        file.stem.replace("info", "log"): float(line.split(":")[1])
        for file in logs.glob("info*.yaml")
        for line in file.read_text(encoding="utf-8").splitlines()
        if line.startswith("mass:")
    }
    lines = ["| motors | reference | flights | mass [kg] | named |", "|---|---|---|---|---|"]
    for motors, (before, after) in MASSES.items():
        nominal, folder = masses[before[0]], out / motors
        files = [logs / name for name in (*before, *after)]
        flights = imported(files, folder / "flights", "--map", "crazyswarm2", "--mass", nominal)
        references = [flights[name] for name in before]
        for mass in sorted({masses[name] for name in after}):
            names = [name for name in after if masses[name] == mass]
            said = changed(folder / f"{mass}", references, [flights[name] for name in names])
            lines.append(
                f"| {motors} | {', '.join(before)} ({nominal}) | {', '.join(names)} | {mass} "
                f"| {said} |"
            )
    return lines


def write_page(logs: Path, out: Path) -> None:
    """Diagnose all three sets, two of them also without a pose, and write the page."""
    no_pose = [word for name in ("pos", "quat", "vel") for word in ("--read", f"{name}=drop")]
    parts = {
        "nanobench": lambda: nanobench(logs / "nanobench", out / "nanobench"),
        "nanobench without a pose": lambda: nanobench(
            logs / "nanobench", out / "nanobench-no-pose", "--partial", *no_pose
        ),
        "crazypad": lambda: crazypad(logs / "crazypad", out / "crazypad"),
        "crazypad without a pose": lambda: crazypad(
            logs / "crazypad", out / "crazypad-no-pose", *no_pose
        ),
        "crazyswarm2": lambda: crazyswarm2(logs / "crazyswarm2", out / "crazyswarm2"),
    }
    page = []
    for name, of in parts.items():
        page += [f"## {name}", "", *of(), ""]
        (out / "real.md").write_text("\n".join(page), encoding="utf-8")


if __name__ == "__main__":
    write_page(Path(sys.argv[1]), Path(sys.argv[2]))
