"""Write a set of blind cases to disk, with the answers in a separate folder, and read it again.

`OUT/set.json` has the seed and options of the set. `OUT/cases/case_001/` has the inputs of a
diagnosis: vehicle.toml, flight_1.parquet, ... `OUT/answers/case_001.json` has the hidden effects,
and `OUT/manifest.json` the hashes of all files.
"""

from __future__ import annotations

import hashlib
import itertools
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from eval.logs.flight_log import write_flight
from eval.quadrotor.vehicle_file import save_vehicle
from eval.worlds import world_class
from suite.blind.build import Built, build
from suite.blind.cases import DRAWERS, MUJOCO, ROTORPY, Case
from suite.blind.oracle import TABLE
from suite.common.console import Console
from suite.common.errors import WorkFailed
from tracks.common.files import replacing_folder, write_json
from tracks.common.provenance import stamp
from tracks.common.work import Workers, run_pieces
from tracks.input.reading import read_json

SCHEMA = 1
"""Version of the files of a set."""
RESULTS = "results"
"""Name of the folder with the diagnoses of a set."""


@dataclass(frozen=True)
class Manifest:
    """The files of a set with their hashes, so that a later change of a file is noticed."""

    cases: dict[str, dict[str, str]]
    """Case -> input file of the diagnosis -> SHA-256 of the file."""
    answers: dict[str, str]
    """Case -> SHA-256 of its answer."""
    failed: dict[str, str] = field(default_factory=dict)
    """Case -> "not made", for cases without valid flights; answers/failed.json has the reasons."""


def make_set(
    out: Path,
    seed: int,
    count: int | None,
    console: Console,
    simulator: str = MUJOCO,
    workers: Workers | None = None,
) -> Manifest:
    """Make the missing cases in `out`, and return the manifest of the set.

    The `count` of cases is approximate; None: all. The simulator is a key of `DRAWERS`; sets of
    others than `mujoco` are smaller. Without workers, this process makes all cases.

    Raises:
        ValueError: if `out` has a set of another seed, count, simulator or table of strengths, a
            file of it has changed, or the simulator is not installed; nothing is written then.
    """
    if simulator == ROTORPY:
        world_class(ROTORPY)
    cases = DRAWERS[simulator](seed, count)
    options = {"seed": seed, "count": count, "simulator": simulator, "strengths": _hash(TABLE)}
    _check_options(out, options)
    names = [
        name
        for name in cases
        if not ((out / "cases" / name).is_dir() and (out / "answers" / f"{name}.json").is_file())
    ]
    if (out / "manifest.json").is_file():
        manifest = load_manifest(out)
        _check_files(out, manifest, [name for name in manifest.cases if name not in names])
    failed: dict[str, str] = {}
    before = len(cases) - len(names)
    numbers = itertools.count(before + 1)
    with console.progress("cases", len(cases), begun=before) as update:

        def keep(number: int, built: Built | str) -> None:
            """Write the files of a case, or keep the reason why it cannot be made."""
            name = names[number]
            update(next(numbers), name)
            if isinstance(built, str):
                failed[name] = built
                return
            # A diagnosis of other flights with this name does not belong to this case.
            shutil.rmtree(out / RESULTS / name, ignore_errors=True)
            # The answer is written first, so that every existing case has one.
            write_json(out / "answers" / f"{name}.json", {**stamp(SCHEMA, seed), **built.answer})
            with replacing_folder(out / "cases" / name) as temporary:
                save_vehicle(built.nominal, temporary / "vehicle.toml")
                for log in built.logs:
                    write_flight(temporary / f"{log.name}.parquet", log)

        run_pieces(_build, [cases[name] for name in names], workers or 1, keep)
    manifest = Manifest({}, {})
    for name in cases:
        if name in failed:
            manifest.failed[name] = "not made"
        else:
            files = sorted((out / "cases" / name).iterdir())
            manifest.cases[name] = {path.name: _hash(path) for path in files}
            manifest.answers[name] = _hash(out / "answers" / f"{name}.json")
    write_json(out / "manifest.json", {**stamp(SCHEMA, seed), **asdict(manifest)})
    # The reasons contain the hidden effects.
    write_json(out / "answers" / "failed.json", {name: failed[name] for name in manifest.failed})
    return manifest


def _build(case: Case) -> Iterator[Built | str]:
    """Yield once: the contents of a case, or the reason why it cannot be made."""
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
    """Return the simulator of the set in `out`."""
    return str(read_json(out / "set.json")["simulator"])


def open_answers(out: Path) -> dict[str, dict[str, Any]]:
    """Return case -> answer, after a check that no file of the set has changed.

    Raises:
        ValueError: for a changed file.
    """
    manifest = load_manifest(out)
    _check_files(out, manifest, manifest.cases)
    return {name: read_json(out / "answers" / f"{name}.json") for name in manifest.cases}


def _check_files(out: Path, manifest: Manifest, names: Iterable[str]) -> None:
    """Refuse a set in which a file of the cases `names` is not that of the manifest."""
    for name in names:
        files = {out / "cases" / name / file: sha for file, sha in manifest.cases[name].items()}
        files[out / "answers" / f"{name}.json"] = manifest.answers[name]
        for path, digest in files.items():
            if not path.is_file() or _hash(path) != digest:
                raise ValueError(
                    f"{path}: not the file that the manifest was made with; make the set again "
                    "in another folder"
                )


def _check_options(out: Path, options: dict[str, Any]) -> None:
    """Write the options of a new set, or refuse others than those of the set in `out`."""
    path = out / "set.json"
    if not path.is_file():
        write_json(path, {**stamp(SCHEMA, options["seed"]), **options})
        return
    stored = read_json(path)
    for key, value in options.items():
        if stored.get(key) != value:
            raise ValueError(
                f"{path}: {key} is {stored.get(key)!r} in the file, {value!r} in this command; "
                "give another --out, or the same options to continue"
            )


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
