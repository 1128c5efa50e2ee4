"""Identify and diagnose real flights of three laboratories, and write the results as a page.

    python tools/real.py LOGS OUT

`suite identify` estimates the parameters of a vehicle file from flights. `suite diagnose` names the
physical effects that the file lacks. LOGS has a folder for each laboratory with the files of its
authors: `nanobench`, `crazypad` and `crazyswarm2` (sources in docs/results/real.md). OUT gets
flights, vehicle files, diagnoses and the page `real.md`.
"""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import tyro

from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from suite.cli import main

FITTED = ("B10_lissajous_fast_rep1", "B2_circle_fast_rep2", "B3_figure8_fast_rep1",
          "B3_figure8_slow_rep2")  # fmt: skip
"""Flights of nanobench from which the vehicle file is estimated; the others are diagnosed."""
MASSES = {
    "upgraded": (
        ("log10", "log12"),
        ("log20", "log50", "log60", "log99", "log100", "log104", "log110"),
    ),
    "standard": (("log150", "log155"), ("log160", "log170", "log180")),
}
"""Motors of the drone of crazyswarm2 -> flights that are the reference, and flights with other
masses that are compared with them."""


def suite(*words: Any) -> dict[str, Any]:
    """Run a command with `--json` and return its output.

    Raises:
        RuntimeError: if the command fails, with its error message.
    """
    output, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        code = main([*map(str, words), "--json"])
    if code:
        raise RuntimeError(f"suite {' '.join(map(str, words))}: {errors.getvalue()[-500:]}")
    return json.loads(output.getvalue())


def import_flights(files: Iterable[Path], folder: Path, *options: Any) -> dict[str, Path]:
    """Import logs into `folder`, and return name -> path of the flights."""
    flights = {}
    for file in sorted(files):
        flights[file.stem] = folder / f"{file.stem}.parquet"
        folder.mkdir(parents=True, exist_ok=True)
        all_options = (*options, "--vehicle", "crazyflie21", "--rate", 100)
        suite("import", file, "--out", flights[file.stem], *all_options)
    return flights


def names_line(diagnosis: dict[str, Any]) -> str:
    """Return the named effects of a diagnosis with their parameters, in a line."""
    named = []
    for effect in diagnosis["effects"]:
        sizes = []
        for key, entry in effect["parameters"].items():
            values = entry["value"] if isinstance(entry["value"], list) else [entry["value"]]
            shown = ", ".join("–" if v is None else f"{v:.3g}" for v in values)
            sizes.append(shown if key == "index" else f"{shown} {entry['unit']}".removesuffix(" 1"))
        or_else = "".join(f" or {name}" for name in effect["alternatives"])
        named.append(f"{effect['name']}{or_else} ({'; '.join(sizes)})")
    return "; ".join(named) or "–"


def nanobench(logs: Path, out: Path, *options: Any) -> list[str]:
    """Return the lines of the page on nanobench: diagnoses with and without the estimated drag.

    `options` are further options of `suite import`, such as those that remove the pose.
    """
    flights = import_flights(logs.glob("*.csv"), out / "flights", "--map", "nanobench", *options)
    fitted = [flights[name] for name in FITTED]
    others = [path for name, path in flights.items() if name not in FITTED]
    vehicle, without_drag = out / "identified.toml", out / "without_drag.toml"
    numbers = suite("identify", *fitted, "--vehicle", "crazyflie21", "--out", vehicle)["parameters"]
    identified = load_vehicle(str(vehicle))
    effects = {name: values for name, values in identified.effects.items() if "drag" not in name}
    reduced = replace(identified, effects=MappingProxyType(effects))
    save_vehicle(reduced, without_drag, "without its drag")
    lines = [
        f"Vehicle file from {', '.join(FITTED)}; diagnosed: "
        f"{', '.join(sorted(path.stem for path in others))}.",
        "",
        "| vehicle file | named | verdict | "
        "force x, y: share of variance explained (black box) | seconds |",
        "|---|---|---|---|---|",
    ]
    for label, file in (("identified, its drag left out", without_drag), ("identified", vehicle)):
        diagnosis = suite("diagnose", *others, "--vehicle", file, "--out", out / file.stem)
        force = diagnosis["gap"]["channels"].get("force", {})
        shares = ", ".join(
            f"{100 * force[a]['closed']:.0f} ({100 * force[a]['explainable']:.0f}) %"
            for a in "xy"
            if a in force
        )
        lines.append(
            f"| {label} | {names_line(diagnosis)} | {diagnosis['verdict']} | {shares or '–'} "
            f"| {diagnosis['seconds']:.0f} |"
        )
    lines += ["", "| identified | value | 95 % interval | unit |", "|---|---|---|---|"]
    for key, entry in numbers.items():
        several = isinstance(entry["value"], list)
        values, spans = (entry[k] if several else [entry[k]] for k in ("value", "ci95"))
        shown = [", ".join(f"{v:.3g}" for v in values)]
        shown += [", ".join(f"{s[0]:.3g} to {s[1]:.3g}" if s else "–" for s in spans)]
        lines.append(f"| {key} | {' | '.join(shown)} | {entry['unit']} |")
    return lines


def named_change(out: Path, references: Sequence[Path], flights: Sequence[Path]) -> str:
    """Return the effects that `flights` have in comparison with `references`, in a line.

    A flight is not compared with itself, so references that are among the flights do not count.
    """
    other_references = [path for path in references if path not in flights]
    if len(other_references) < 2:
        return "too few references"
    diagnosis = suite("diagnose", *flights, "--reference", *other_references,
                      "--vehicle", "crazyflie21", "--out", out)  # fmt: skip
    return names_line(diagnosis)


def crazypad(logs: Path, out: Path, *options: Any) -> list[str]:
    """Return the lines of the page on crazypad.

    The flights of each condition, such as an added weight, are diagnosed together and one by one.
    The reference are the normal flights of the same vehicle. With `options`, which remove the pose,
    only the controller logs are used, since they have body rates.
    """
    lines = [
        "| logs, vehicle | condition | all flights together | each alone |",
        "|---|---|---|---|",
    ]
    for kind in ("controller",) if options else ("motor", "controller"):
        folder = out / kind
        flights = import_flights((logs / kind).iterdir(), folder / "flights", "--map", "crazypad",
                           "--partial", *options)  # fmt: skip
        for vehicle in ("E8", "E9"):
            of_vehicle = {n: path for n, path in flights.items() if f"__{vehicle}_" in n}
            normal = [path for name, path in of_vehicle.items() if name.startswith("normal")]
            for condition in sorted({name.split("__")[0] for name in of_vehicle}):
                start = f"{condition}__"
                paths = [path for name, path in of_vehicle.items() if name.startswith(start)]
                together = "–" if condition == "normal_flight" else named_change(
                    folder / f"{condition}__{vehicle}", normal, paths)  # fmt: skip
                each = [named_change(folder / path.stem, normal, [path]) for path in paths]
                lines.append(
                    f"| {kind}, {vehicle} | {condition} | {together} | {'<br>'.join(each)} |"
                )
    return lines


def crazyswarm2(logs: Path, out: Path) -> list[str]:
    """Return the lines of the page on crazyswarm2.

    Flights with the same mass are diagnosed together, in comparison with the reference flights.
    """
    masses = {
        file.stem.replace("info", "log"): float(line.split(":")[1])
        for file in logs.glob("info*.yaml")
        for line in file.read_text(encoding="utf-8").splitlines()
        if line.startswith("mass:")
    }
    lines = ["| motors | reference | flights | mass [kg] | named |", "|---|---|---|---|---|"]
    for motors, (base, compared_names) in MASSES.items():
        nominal, folder = masses[base[0]], out / motors
        files = [logs / name for name in (*base, *compared_names)]
        flights = import_flights(
            files, folder / "flights", "--map", "crazyswarm2", "--mass", nominal
        )
        references = [flights[name] for name in base]
        for mass in sorted({masses[name] for name in compared_names}):
            names = [name for name in compared_names if masses[name] == mass]
            paths = [flights[name] for name in names]
            named = named_change(folder / f"{mass}", references, paths)
            lines.append(
                f"| {motors} | {', '.join(base)} ({nominal}) | {', '.join(names)} | {mass} "
                f"| {named} |"
            )
    return lines


def write_page(logs: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path]) -> None:
    """Diagnose the flights of the three laboratories, and write the page.

    The flights of two laboratories are also diagnosed without their pose.
    """
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
    for name, lines_of in parts.items():
        page += [f"## {name}", "", *lines_of(), ""]
        (out / "real.md").write_text("\n".join(page), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(write_page)
