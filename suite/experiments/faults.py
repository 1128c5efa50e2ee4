"""The page `faults`: how many injected faults are named in simulated and real logs.

Each case takes a correct log, puts one fault of its interface into it, and imports and checks the
result. `suite check` and `suite import` should report the fault by name, and report nothing in logs
without a fault.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from eval.importers import import_log
from eval.importers.options import ImportOptions
from eval.logs.faults.check import CheckContext, check_files, check_log, rows_of
from eval.logs.flight_log import FlightLog, read_flight
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from eval.vehicles.vehicle import Vehicle, with_effects
from suite.common.console import Console
from suite.experiments.injected.flights import (
    REAL_MOTORS,
    TRUE_EFFECTS,
    as_log,
    flight_signals,
    real_logs,
    with_linear_motors,
)
from suite.experiments.injected.kinds import KINDS, Kind, inject
from suite.experiments.injected.writers import WRITERS
from suite.experiments.pages.document import PageContents
from suite.experiments.study.cache import MEASURED, Workspace, code_digest, digest
from suite.experiments.study.judging import policy_facts
from suite.judging.collect import collect
from suite.judging.flying import default_policy
from suite.judging.requests import Collection
from tracks.common.files import write_text
from tracks.common.grid import Grid, table
from tracks.common.provenance import git_commit
from tracks.common.work import run_pieces
from tracks.input.ranges import Range, Seed

FLIGHT_LOG = "flight log"
"""Label of the suite's format of flight logs."""
FORMATS = (*WRITERS, FLIGHT_LOG)
"""Formats of the simulated logs."""
POLICY_HZ = 30.0
"""Decision rate of the policy that the simulated logs are checked against [Hz]."""
OUTCOMES = ("named", "not identifiable", "refused", "another name", "silent")
"""Outcomes of a faulty log. Its fault is named, or reported as not identifiable. Or the import
refuses the log with a reason. Or only another fault is named. Or nothing is reported."""


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
    """The injected fault, a key of `KINDS`; "" for none."""
    format: str
    """One of `FORMATS`, or "real"."""
    path: Path
    """The log of the flight without a fault."""
    number: int
    """Number of the flight; it is a part of the seed of its noise."""


def document(config: Config, workspace: Workspace, console: Console) -> PageContents:
    """Return the contents of the page; missing flights and checks are made first.

    Raises:
        ValueError: for a cluster, since the logs are files of this machine, and for a vehicle
            without a flight of 4 s.
    """
    if isinstance(workspace.workers, str):
        raise ValueError(
            f"--workers is {workspace.workers}; allowed for this page is a number of processes, "
            "because the logs are files of this machine"
        )
    vehicle = load_vehicle(config.vehicle)
    policy = policy_facts({"policy": default_policy()})
    count = max(config.clean, config.flights * len(FORMATS))
    inputs = [vehicle, config.seed, git_commit(), code_digest("eval"), policy, count]
    folder = workspace.cache / f"faults-{digest(inputs)}"
    flights = _fly(count, config, vehicle, folder, console)
    faulty = list(_simulated_cases(config, flights))
    clean = [
        Case("", FORMATS[k % len(FORMATS)], path, k)
        for k, path in enumerate(flights[: config.clean])
    ]
    real = real_logs(config.real)
    faulty_real = list(_real_cases(real, config.flights))
    clean_real = [Case("", "real", path, 0) for path in real]
    cases = [*faulty, *clean, *faulty_real, *clean_real]
    answers = _check_cases(cases, config, folder, console, workspace)
    groups = {"simulated": faulty, "real": faulty_real}
    parts = {
        f"Faults in {name} logs": [_kinds_grid([(c, answers[c]) for c in group])]
        for name, group in groups.items()
        if group
    }
    parts["Logs without a fault"] = [_clean_grid([(c, answers[c]) for c in (*clean, *clean_real)])]
    facts = {
        **policy,
        "flights": f"{len(flights)} simulated ones on all tracks, levels 0, 3 and 6, vehicle "
        f"{config.vehicle} with its centre of mass off by 6 and -3 mm, measured with noise; "
        f"checked against {config.vehicle} and a policy of {POLICY_HZ:g} Hz",
        "formats": ", ".join(FORMATS),
        "real logs": f"{len(real)} of {config.real.name}" if real else "none here",
        "kinds": f"{len(KINDS)}, {sum(k.race for k in KINDS.values())} of them (race) were "
        "seen in vision races, where they ended flights",
        "seed": str(config.seed),
    }
    numbers = {
        name: Counter(_outcome(c, answers[c]) for c in group) for name, group in groups.items()
    }
    false_alarms = [c for c in clean if _reported_faults(answers[c])]
    return PageContents(
        facts, parts, {"outcomes": numbers, "clean": len(clean), "accused": len(false_alarms)}
    )


def _fly(
    count: int, config: Config, vehicle: Vehicle, folder: Path, console: Console
) -> list[Path]:
    """Return `count` logs of flights of more than 4 s, without faults; missing ones are flown."""
    true_vehicle = with_effects(vehicle, TRUE_EFFECTS)
    folder.mkdir(parents=True, exist_ok=True)
    title = "the nominal vehicle, its centre of mass moved"
    save_vehicle(true_vehicle, folder / "true.toml", title)
    collection = Collection(
        difficulty="0,3,6",
        # Trials for each of 9 tracks and levels: a fifth more flights than needed, rounded up,
        # because those under 4 s are left out.
        trials=-(-count * 12 // (9 * 10)),
        vehicle=str(folder / "true.toml"),
        seed=config.seed,
    )
    flights = collect(collection, folder / "flights", console, None)["flights"]
    paths = [
        folder / "flights" / row["file"] for row in flights if row["file"] and row["time_s"] > 4
    ]
    if not paths:
        raise ValueError(
            f"--vehicle {config.vehicle}: no flight of {len(flights)} lasts more than 4 s; give a "
            "vehicle that the shipped policy can fly"
        )
    order = np.random.default_rng(config.seed).permutation(len(paths))
    return [paths[k] for k in order][:count]


def _simulated_cases(config: Config, flights: Sequence[Path]) -> Iterator[Case]:
    """Yield `config.flights` cases per kind of fault.

    The formats alternate, among those that have the signals that the fault changes.
    """
    for number, (name, kind) in enumerate(KINDS.items()):
        formats = [f for f in kind.formats or FORMATS if kind.fits(_signals_of(f))]
        for k in range(config.flights):
            index = (number * config.flights + k) % len(flights)
            yield Case(name, formats[k % len(formats)], flights[index], index)


def _signals_of(format: str) -> set[str]:
    """Return the signals that a written flight of a format holds."""
    common = {"time", "pos", "quat", "rate", "acc", "motor", "cmd_rate", "throttle", "voltage"}
    others = {
        "px4": {"vel"},
        "crazyflie": {"vel", "pwm"},
        "betaflight": {"pwm"},
        "table": {"vel", "pwm"},
        FLIGHT_LOG: {"vel", "pwm", "baro", "cmd_thrust"},
    }
    return common | others[format]


def _real_cases(real: Sequence[Path], count: int) -> Iterator[Case]:
    """Yield `count` cases per kind of fault, from the sets of real logs.

    The sets alternate, among those that have the signals that the fault changes. A set is a folder.
    """
    sets: dict[Path, list[Path]] = {}
    for path in real:
        sets.setdefault(path.parent, []).append(path)
    signals = {folder: set(rows_of(_import_real(paths[0])[0])) for folder, paths in sets.items()}
    for number, (name, kind) in enumerate(KINDS.items()):
        suitable = [paths for folder, paths in sets.items() if kind.fits(signals[folder])]
        for k in range(count if suitable else 0):
            paths = suitable[(number + k) % len(suitable)]
            index = (3 * number + k // len(suitable)) % len(paths)
            yield Case(name, "real", paths[index], k)


Answer = list[dict[str, Any]] | str
"""Findings in the log of a case, one dictionary each, or the reason why the import refused it."""


def _check_cases(
    cases: Sequence[Case], config: Config, folder: Path, console: Console, workspace: Workspace
) -> dict[Case, Answer]:
    """Return the answer to every case; those of an interrupted run are read from its file."""
    code = code_digest(*MEASURED["faults"])
    path = folder / f"checked-{code}.jsonl"
    names = {
        log: f"{log.parent.name}/{log.name}|{sha256(log.read_bytes()).hexdigest()[:16]}"
        for log in {case.path for case in cases}
    }
    keys = {f"{c.kind}|{c.format}|{names[c.path]}|{c.number}": c for c in cases}
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    # If a kill left an incomplete last line, it is dropped.
    lines = text.splitlines(keepends=True)[: text.count("\n")]
    write_text(path, "".join(lines))
    answers = {k: a for k, a in map(json.loads, lines) if k in keys}
    missing = [key for key in keys if key not in answers]
    with (
        console.progress("logs", len(cases), begun=len(answers)) as show,
        path.open("a", encoding="utf-8") as file,
    ):

        def keep(number: int, answer: Answer) -> None:
            """Store an answer in the file, so that an interrupted run can continue."""
            answers[missing[number]] = answer
            file.write(json.dumps([missing[number], answer]) + "\n")
            file.flush()
            show(len(answers), missing[number])

        check = partial(_check, vehicle_name=config.vehicle, seed=config.seed)
        run_pieces(check, [keys[key] for key in missing], workspace.workers or 1, keep)
    return {c: answers[key] for key, c in keys.items()}


def _check(case: Case, vehicle_name: str, seed: int) -> Iterator[Answer]:
    """Inject the fault of a case, import and check the faulty log, and yield the answer.

    It is a generator because `run_pieces` expects one; it yields once.
    """
    kind = KINDS.get(case.kind, Kind(()))
    rng = np.random.default_rng([seed, case.number, len(case.kind)])
    if case.format == "real":
        log, vehicle = _import_real(case.path)
        signals = rows_of(log)
    else:
        vehicle = with_linear_motors(load_vehicle(vehicle_name))
        signals = flight_signals(read_flight(case.path), vehicle, rng)
    faulty = inject(kind, signals, vehicle) if kind.names else signals
    vehicle = vehicle if kind.vehicle is None else kind.vehicle(vehicle)
    wide, high = vehicle.camera.fov_deg
    camera = replace(vehicle.camera, fov_deg=(kind.fov * wide, kind.fov * high))
    policy_hz = POLICY_HZ if case.format != "real" else None
    context = CheckContext(vehicle, policy_hz, camera)
    try:
        if case.format in WRITERS:
            # The format of another program is written to a file; the import gives findings, too.
            with tempfile.TemporaryDirectory() as folder:
                written = WRITERS[case.format](Path(folder), faulty)
                options = replace(written.options, vehicle=vehicle)
                log, findings = import_log(written.path, case.format, options)
        else:
            log, findings = as_log(faulty, case.path.name), []
        findings = [*findings, *check_log(log, context)[0], *check_files(context)]
    except ValueError as error:
        yield str(error).splitlines()[0]
        return
    yield [f._asdict() for f in findings if f.fault and f.status != "ok"]


def _import_real(path: Path) -> tuple[FlightLog, Vehicle]:
    """Return a real log after its import, and the vehicle that it is compared with."""
    name = path.parent.name if path.parent.name in ("nanobench", "crazyswarm2") else "crazypad"
    vehicle = load_vehicle("crazyflie21")
    vehicle = replace(vehicle, motors=REAL_MOTORS.get(name, vehicle.motors))
    options = ImportOptions(map=Path(name), partial=True, vehicle=vehicle)
    return import_log(path, None, options)[0], vehicle


def _reported_faults(answer: Answer) -> list[str]:
    """Return the names of the reported faults, or "refused" for a log that was not imported."""
    if isinstance(answer, str):
        return ["refused"]
    return [f["fault"] for f in answer if f["status"] != "not identifiable"]


def _outcome(case: Case, answer: Answer) -> str:
    """Return the outcome of a faulty log, one of `OUTCOMES`."""
    names, reported = set(KINDS[case.kind].names), set(_reported_faults(answer))
    if isinstance(answer, str):
        return "refused"
    if reported & names:
        return "named"
    if names & {f["fault"] for f in answer}:
        return "not identifiable"
    return "another name" if reported else "silent"


def _kinds_grid(answers: Iterable[tuple[Case, Answer]]) -> Grid:
    """Return a table with the number of logs by outcome, a row per kind of fault."""
    count = Counter((case.kind, _outcome(case, answer)) for case, answer in answers)
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


def _clean_grid(answers: Iterable[tuple[Case, Answer]]) -> Grid:
    """Return a table with the false alarms in logs without a fault, a row per format."""
    logs, false_alarms, names = Counter[str](), Counter[str](), Counter[tuple[str, str]]()
    for case, answer in answers:
        reported = _reported_faults(answer)
        logs[case.format] += 1
        false_alarms[case.format] += bool(reported)
        names.update((case.format, name) for name in reported)
    rows = [
        [format, str(count), str(false_alarms[format]),
         ", ".join(f"{name} {c}" for (of, name), c in names.items() if of == format)]
        for format, count in logs.items()
    ]  # fmt: skip
    simulated = [str(sum(c[f] for f in logs if f != "real")) for c in (logs, false_alarms)]
    rows.append(["all simulated", *simulated, ""])
    return table(["format", "logs", "with a finding", "which"], rows)
