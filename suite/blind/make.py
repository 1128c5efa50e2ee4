"""A set of cases on disk: the diagnosis's inputs, and the answers in a separate folder.

`OUT/set.json` has the seed and options of the set. `OUT/cases/case_001/` has vehicle.toml,
flight_1.parquet and so on, the inputs of a diagnosis; `OUT/answers/case_001.json` the hidden
effects; `OUT/manifest.json` the hashes of all files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from eval.logs.flight_log import write_flight
from eval.quadrotor.vehicle_file import save_vehicle
from eval.worlds import world_class
from suite.blind.build import Built, build
from suite.blind.cases import DRAWERS, MUJOCO, ROTORPY, Case
from suite.blind.oracle.strength import TABLE
from suite.common.console import Console
from suite.common.errors import WorkFailed
from tracks.common.files import replacing_folder, write_json
from tracks.common.provenance import stamp
from tracks.common.work import Workers, run_pieces
from tracks.input.reading import read_json

SCHEMA = 1


@dataclass(frozen=True)
class Manifest:
    """The files of a set."""

    cases: dict[str, dict[str, str]]
    """By case: SHA-256 of each input file of the diagnosis."""
    answers: dict[str, str]
    """By case: SHA-256 of its answer."""
    failed: dict[str, str] = field(default_factory=dict)
    """By case: the reason for which it could not be made."""


def make_set(
    out: Path,
    seed: int,
    count: int | None,
    console: Console,
    simulator: str = MUJOCO,
    workers: Workers | None = None,
) -> Manifest:
    """Make the missing cases in `out`, and the manifest.

    Args:
        out: folder of the set.
        seed: of the set.
        count: approximate number of cases; None: all.
        console: shows progress.
        simulator: one of `DRAWERS`; all but `mujoco` have smaller sets.
        workers: of the cases; None: this process.

    Raises:
        ValueError: if `out` has a set of another seed, count, simulator or table of strengths, or
            the simulator is not installed; nothing is written then.
    """
    if simulator == ROTORPY:
        world_class(ROTORPY)
    cases = DRAWERS[simulator](seed, count)
    about = {"seed": seed, "count": count, "simulator": simulator, "strengths": _hash(TABLE)}
    _same_set(out, about)
    names = [
        name
        for name in cases
        if not ((out / "cases" / name).is_dir() and (out / "answers" / f"{name}.json").is_file())
    ]
    failed: dict[str, str] = {}
    with console.progress("cases", len(cases)) as update:

        def keep(number: int, built: Built | str) -> None:
            name = names[number]
            if isinstance(built, str):
                failed[name] = built
                return
            # The answer first: every existing case has one.
            write_json(out / "answers" / f"{name}.json", {**stamp(SCHEMA, seed), **built.answer})
            with replacing_folder(out / "cases" / name) as temporary:
                save_vehicle(built.nominal, temporary / "vehicle.toml")
                for log in built.logs:
                    write_flight(temporary / f"{log.name}.parquet", log)
            update(len(cases) - len(names) + number + 1, name)

        run_pieces(_build, [cases[name] for name in names], workers or 1, keep)
    made = [name for name in cases if name not in failed]
    manifest = Manifest(
        {
            name: {path.name: _hash(path) for path in sorted((out / "cases" / name).iterdir())}
            for name in made
        },
        {name: _hash(out / "answers" / f"{name}.json") for name in made},
        {name: "not made" for name in cases if name in failed},
    )
    write_json(out / "manifest.json", {**stamp(SCHEMA, seed), **asdict(manifest)})
    # The reasons contain the hidden effects.
    write_json(out / "answers" / "failed.json", {n: failed[n] for n in cases if n in failed})
    return manifest


def _build(case: Case) -> Iterator[Built | str]:
    """Yield the contents of a case, or the reason for which it cannot be made."""
    try:
        yield build(case)
    except WorkFailed as error:
        yield str(error)


def load_manifest(out: Path) -> Manifest:
    """Return the manifest of the set in `out`.

    Raises:
        ValueError: if there is none.
    """
    path = out / "manifest.json"
    if not path.is_file():
        raise ValueError(f"{path}: missing; make the set first with `suite blind make`")
    table = read_json(path, cases=dict, answers=dict, failed=dict)
    return Manifest(table["cases"], table["answers"], table["failed"])


def simulator_of(out: Path) -> str:
    """Return the simulator of the set in `out`; MuJoCo if it is not recorded."""
    path = out / "set.json"
    return str(read_json(path).get("simulator", MUJOCO)) if path.is_file() else MUJOCO


def open_answers(out: Path) -> dict[str, dict[str, Any]]:
    """Return the answers by case, after checking that no file of the set has changed.

    Raises:
        ValueError: for a changed file.
    """
    manifest = load_manifest(out)
    answers = {}
    for name, files in manifest.cases.items():
        answer = out / "answers" / f"{name}.json"
        made = {out / "cases" / name / file: digest for file, digest in files.items()}
        for path, digest in {**made, answer: manifest.answers[name]}.items():
            if not path.is_file() or _hash(path) != digest:
                raise ValueError(
                    f"{path}: not the file that the manifest was made with; make the set again "
                    "elsewhere"
                )
        answers[name] = read_json(answer)
    return answers


def _same_set(out: Path, wanted: dict[str, Any]) -> None:
    path = out / "set.json"
    there = read_json(path) if path.is_file() else None
    if there is None:
        write_json(path, {**stamp(SCHEMA, wanted["seed"]), **wanted})
        return
    for key, value in wanted.items():
        if there.get(key) != value:
            raise ValueError(
                f"{path}: {key} is {there.get(key)!r} there, {value!r} here; "
                "give another --out, or the same options to go on"
            )


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
