"""Faults injected into simulated and real logs: detection rate and false-alarm rate.

A fault is an error of interface or log: a unit, sign, scale, order, delay or rate. `suite check`
and `suite import` should report it by name, and report nothing in logs without a fault.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from eval.importers import import_log
from eval.importers.options import ImportOptions
from eval.logs.faults.check import CheckContext, check_files, check_log, rows_of
from eval.logs.faults.finding import Finding
from eval.logs.flight_log import FlightLog, read_flight
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from eval.vehicles.vehicle import Vehicle, with_effects
from suite.common.console import Console
from suite.experiments.injected.flights import TRUE_EFFECTS, as_log, flight_parts, real_logs
from suite.experiments.injected.kinds import KINDS, Kind, inject
from suite.experiments.injected.writers import WRITERS
from suite.experiments.pages.document import Made
from suite.experiments.study.cache import Place, code_digest, digest
from suite.judging.collect import collect
from suite.judging.requests import Collection
from tracks.common.grid import Grid, table
from tracks.common.provenance import git_commit
from tracks.common.work import run_pieces
from tracks.input.ranges import Range, Seed

OWN = "flight log"
FORMATS = (*WRITERS, OWN)
POLICY_HZ = 30.0
OUTCOMES = ("named", "not identifiable", "refused", "another name", "silent")
"""Outcomes of a faulty log: its fault is named, or reported as not identifiable; the log is refused
with a reason; only another fault is named; or it is imported without a finding."""


@dataclass(frozen=True)
class Config:
    """Put every kind of fault into simulated logs of four formats and real ones, and check them."""

    flights: Annotated[int, Range(1, 100)] = 5
    """Simulated flights for each kind of fault, in formats that alternate."""
    clean: Annotated[int, Range(1, 2000)] = 200
    """Simulated flights without a fault."""
    real: Path = Path("../shared/real_logs")
    """Folder of real logs (nanobench, crazyswarm2, crazypad); without it simulated logs alone."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml); it flies with an offset centre of
    mass."""
    seed: Seed = 7_000_000
    """Seed of the flights, their noise and the faults."""


@dataclass(frozen=True)
class Case:
    """One log to check."""

    kind: str
    """A key of `KINDS`; "" for none."""
    format: str
    path: Path
    """The good flight."""
    number: int
    """Number of the flight, the seed of its noise."""


def document(config: Config, place: Place, console: Console) -> Made:
    """Return the tables; flights and logs that are missing are made first."""
    vehicle = load_vehicle(config.vehicle)
    same = [config.vehicle, config.seed, git_commit(), code_digest("eval")]
    folder = place.cache / f"faults-{digest(same)}"
    good = _flights(config, vehicle, folder, console)
    faulty = list(_faulty(config, good))
    clean = [
        Case("", FORMATS[k % len(FORMATS)], path, k) for k, path in enumerate(good[: config.clean])
    ]
    real = real_logs(config.real)
    on_real = list(_on_real(real, config.flights))
    intact = [Case("", "real", path, 0) for path in real]
    cases = [*faulty, *clean, *on_real, *intact]
    done = _checked(cases, config, folder, console, place)
    groups = {"simulated": faulty, "real": on_real}
    parts = {
        f"Faults in {name} logs": [_kinds_grid([(c, done[c]) for c in held])]
        for name, held in groups.items()
        if held
    }
    parts["Logs without a fault"] = [_clean_grid([(c, done[c]) for c in (*clean, *intact)])]
    facts = {
        "flights": f"{len(good)} of the judge on all tracks, levels 0, 3 and 6, vehicle "
        f"{config.vehicle} with its centre of mass off by 6 and -3 mm, measured with noise; "
        f"checked against {config.vehicle} and a policy of {POLICY_HZ:g} Hz",
        "formats": ", ".join(FORMATS),
        "real logs": f"{len(real)} of {config.real.name}" if real else "none here",
        "kinds": f"{len(KINDS)}, {sum(k.race for k in KINDS.values())} of them (race) were "
        "seen in vision races, where they ended flights",
        "seed": str(config.seed),
    }
    numbers = {name: Counter(_outcome(c, done[c]) for c in held) for name, held in groups.items()}
    false_alarms = [c for c in clean if _reported(done[c])]
    return Made(
        facts, parts, {"outcomes": numbers, "clean": len(clean), "accused": len(false_alarms)}
    )


def _flights(config: Config, vehicle: Vehicle, folder: Path, console: Console) -> list[Path]:
    """Return good flights of at least 4 s; missing ones are flown first."""
    count = max(config.clean, config.flights * len(FORMATS))
    true = with_effects(vehicle, TRUE_EFFECTS)
    folder.mkdir(parents=True, exist_ok=True)
    save_vehicle(true, folder / "true.toml", "the nominal vehicle, its centre of mass moved")
    collection = Collection(
        difficulty="0,3,6",
        # Trials for each of 9 tracks and levels: a fifth more flights than wanted, rounded up, as
        # those under 4 s are left out.
        trials=-(-count * 12 // (9 * 10)),
        vehicle=str(folder / "true.toml"),
        seed=config.seed,
    )
    flown = collect(collection, folder / "flights", console, None)["flights"]
    paths = [folder / "flights" / row["file"] for row in flown if row["file"] and row["time_s"] > 4]
    order = np.random.default_rng(config.seed).permutation(len(paths))
    return [paths[k] for k in order][:count]


def _faulty(config: Config, good: Sequence[Path]) -> Iterator[Case]:
    for number, (name, kind) in enumerate(KINDS.items()):
        able = [f for f in FORMATS if kind.fits(_holds(f))]
        for k in range(config.flights):
            at = (number * config.flights + k) % len(good)
            yield Case(name, able[k % len(able)], good[at], at)


def _holds(format: str) -> set[str]:
    common = {"time", "pos", "quat", "rate", "acc", "motor", "cmd_rate", "throttle", "voltage"}
    return common | {"betaflight": set(), OWN: {"vel", "baro", "cmd_thrust"}}.get(format, {"vel"})


def _on_real(real: Sequence[Path], count: int) -> Iterator[Case]:
    """Yield `count` real logs a kind, of all sets of logs that hold the signals of the fault."""
    sets: dict[Path, list[Path]] = {}
    for path in real:
        sets.setdefault(path.parent, []).append(path)
    holds = {folder: set(rows_of(_real(paths[0])[0])) for folder, paths in sets.items()}
    for number, (name, kind) in enumerate(KINDS.items()):
        able = [paths for folder, paths in sets.items() if kind.fits(holds[folder])]
        for k in range(count if able else 0):
            paths = able[(number + k) % len(able)]
            yield Case(name, "real", paths[(3 * number + k // len(able)) % len(paths)], k)


Answer = list[dict[str, Any]] | str
"""Records of findings, or the reason of a refusal."""


def _checked(
    cases: Sequence[Case], config: Config, folder: Path, console: Console, place: Place
) -> dict[Case, Answer]:
    """Return the findings of every case; those of an interrupted run are reused."""
    path = folder / f"checked-{code_digest('suite/experiments/injected', 'eval/importers')}.jsonl"
    keys = {f"{c.kind}|{c.format}|{c.path.parent.name}/{c.path.name}": c for c in cases}
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    done = {k: a for k, a in map(json.loads, lines) if k in keys}
    left = [key for key in keys if key not in done]
    with console.progress("logs", len(cases)) as show, path.open("a", encoding="utf-8") as file:

        def keep(number: int, answer: Answer) -> None:
            done[left[number]] = answer
            file.write(json.dumps([left[number], answer]) + "\n")
            file.flush()
            show(len(done), left[number])

        check = partial(_check, vehicle_name=config.vehicle, seed=config.seed)
        run_pieces(check, [keys[key] for key in left], place.workers or 1, keep)
    return {c: done[key] for key, c in keys.items()}


def _check(case: Case, vehicle_name: str, seed: int) -> Iterator[Answer]:
    """Yield the findings in one log."""
    kind = KINDS.get(case.kind, Kind(()))
    rng = np.random.default_rng([seed, case.number, len(case.kind)])
    if case.format == "real":
        log, vehicle = _real(case.path)
        parts = rows_of(log)
    else:
        vehicle = load_vehicle(vehicle_name)
        parts = flight_parts(read_flight(case.path), vehicle, rng)
    wrong = inject(kind, parts, vehicle) if kind.names else parts
    vehicle = vehicle if kind.vehicle is None else kind.vehicle(vehicle)
    fov = tuple(kind.fov * angle for angle in vehicle.camera.fov_deg)
    hz = POLICY_HZ if case.format != "real" else None
    context = CheckContext(vehicle, hz, (fov[0], fov[1]))
    try:
        found = _findings(case, wrong, vehicle, context)
    except ValueError as error:
        yield str(error).splitlines()[0]
        return
    yield [f._asdict() for f in found if f.fault and f.status != "ok"]


def _findings(case: Case, parts: dict[str, np.ndarray], vehicle: Vehicle, context: CheckContext
              ) -> list[Finding]:  # fmt: skip
    if case.format in WRITERS:
        with tempfile.TemporaryDirectory() as folder:
            written = WRITERS[case.format](Path(folder), parts, vehicle.full_thrust)
            options = replace(written.options, vehicle=vehicle)
            log, found = import_log(written.path, case.format, options)
        return [*found, *check_log(log, context)[0], *check_files(context)]
    return [*check_log(as_log(parts, case.path.name), context)[0], *check_files(context)]


def _real(path: Path) -> tuple[FlightLog, Vehicle]:
    """Return an imported real log, and the vehicle that it is compared with."""
    name = path.parent.name if path.parent.name in ("nanobench", "crazyswarm2") else "crazypad"
    vehicle = load_vehicle("crazyflie21")
    options = ImportOptions(map=Path(name), partial=True, vehicle=vehicle)
    return import_log(path, None, options)[0], vehicle


def _reported(answer: Answer) -> list[str]:
    """Return the names of the reported faults, or "refused" for a log that was not imported."""
    if isinstance(answer, str):
        return ["refused"]
    return [f["fault"] for f in answer if f["status"] != "not identifiable"]


def _outcome(case: Case, answer: Answer) -> str:
    names, reported = set(KINDS[case.kind].names), set(_reported(answer))
    if isinstance(answer, str):
        return "refused"
    if reported & names:
        return "named"
    if names & {f["fault"] for f in answer}:
        return "not identifiable"
    return "another name" if reported else "silent"


def _kinds_grid(done: Iterable[tuple[Case, Answer]]) -> Grid:
    count = Counter((case.kind, _outcome(case, answer)) for case, answer in done)
    rows = [
        [("(race) " if KINDS[kind].race else "") + kind, " or ".join(KINDS[kind].names)]
        + [str(count[kind, outcome] or "") for outcome in OUTCOMES]
        for kind in dict.fromkeys(kind for kind, _ in count)
    ]
    total, logs = Counter[str](), count.total()
    for (_, outcome), number in count.items():
        total[outcome] += number
    shares = [f"{total[outcome]} ({total[outcome] / logs:.1%})" for outcome in OUTCOMES]
    return table(["fault", "name", *OUTCOMES], [*rows, ["all", f"{logs} logs", *shares]])


def _clean_grid(done: Iterable[tuple[Case, Answer]]) -> Grid:
    logs, false_alarms, names = Counter[str](), Counter[str](), Counter[tuple[str, str]]()
    for case, answer in done:
        reported = _reported(answer)
        logs[case.format] += 1
        false_alarms[case.format] += bool(reported)
        names.update((case.format, name) for name in reported)
    rows = [
        [format, str(count), str(false_alarms[format]),
         ", ".join(f"{name} {c}" for (where, name), c in names.items() if where == format)]
        for format, count in logs.items()
    ]  # fmt: skip
    simulated = [str(sum(c[f] for f in logs if f != "real")) for c in (logs, false_alarms)]
    rows.append(["all simulated", *simulated, ""])
    return table(["format", "logs", "with a finding", "which"], rows)
