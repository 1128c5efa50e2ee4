"""Measure the cost of a piece of work, and the load of the driver: the figures of docs/scaling.md.

    python tools/pieces.py costs                          one piece of each kind, in this process
    python tools/pieces.py engine --count 100000          a local cluster of two workers
    python tools/pieces.py engine --workers 2             processes here, or a cluster's address
    python tools/pieces.py journal --count 1000000
    python tools/pieces.py sweep --count 10000

A piece is independent work, such as a trial, a training or a blind case. The driver is the process
that sends pieces to workers and keeps the results. Only `costs` computes real pieces. The pieces of
`engine` do nothing, and the trials of `journal` and `sweep` are copies of one, so that only the
driver's work is measured. Seconds are processor time, unless "wall" is printed.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil

from suite.common.console import Silent
from tracks.common.work import Workers, read_workers, run_pieces
from tracks.common.work.pickling import pack
from tracks.common.work.threads import set_threads

if TYPE_CHECKING:
    from eval.worlds.trial import TrialResult

MB = 1e6
"""Bytes in a megabyte."""
PROGRESS_EVERY = 10_000
"""Number of pieces between two printed lines about the progress."""


class Clock:
    """A clock that measures processor time and wall time, and prints both."""

    def __init__(self) -> None:
        """Start the clock."""
        self.wall, self.busy = time.monotonic(), _processor_s()

    def say(self, what: str, count: int = 1) -> None:
        """Print the time since the last line, for the work `what` that was done `count` times."""
        wall, busy = time.monotonic() - self.wall, _processor_s() - self.busy
        each = f", {1e6 * busy / count:.0f} us each" if count > 1 else ""
        print(f"{what}: {busy:.1f} s ({wall:.1f} s wall){each}; {memory_mb():.0f} MB", flush=True)
        self.wall, self.busy = time.monotonic(), _processor_s()


def _processor_s() -> float:
    """Return the processor time of this process and its ended children [s]."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def memory_mb() -> float:
    """Return the memory of this process [MB]."""
    return psutil.Process().memory_info().rss / MB


def empty_piece(size: int, piece: int) -> Iterator[bytes]:
    """Yield `size` bytes as the result of a piece."""
    yield bytes(size)


@contextlib.contextmanager
def workers_of(text: str | None) -> Iterator[Workers]:
    """Yield the workers that `text` describes as in --workers; without it a new local cluster."""
    if text:
        yield read_workers(text) or 1
        return
    from distributed import LocalCluster

    make_cluster: Any = LocalCluster
    with make_cluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        print(f"scheduler and two workers on {os.cpu_count()} cores")
        yield cluster.scheduler_address


def engine(count: int, args: argparse.Namespace) -> None:
    """Measure the load of the driver with `count` pieces that do nothing."""
    with workers_of(args.workers) as workers:
        done, clock, started = 0, Clock(), time.monotonic()

        def keep(number: int, result: bytes) -> None:
            """Count a finished piece, and print the progress."""
            nonlocal done
            done += 1
            if done % PROGRESS_EVERY == 0:
                rate = done / (time.monotonic() - started)
                print(f"{done}: {rate:.0f} a second, {memory_mb():.0f} MB", flush=True)

        run_pieces(partial(empty_piece, args.size), range(count), workers, keep)
        clock.say(f"{done} pieces of {args.size} bytes, time of the driver", done)
        for process in psutil.Process().children(recursive=True):
            with contextlib.suppress(psutil.Error):
                spent = sum(process.cpu_times()[:2])
                print(f"  {process.name()}: {spent:.1f} s, {process.memory_info().rss / MB:.0f} MB")


def some_trial(number: int) -> TrialResult:
    """Return the result of an invented trial, whose level and seed follow from `number`."""
    from eval.worlds.trial import TrialResult

    # The fields after `v_mean` do not matter here.
    last_fields = dict.fromkeys(TrialResult._fields[16:], 0)
    return TrialResult(
        "zigzag", number % 10, number, "p", "v", "mujoco", True, 8, "finished", None,
        0.123456789, 0.2, 0.3, 5.0, 4.0, 3.0, **last_fields,
    )  # fmt: skip


def journal(count: int, args: argparse.Namespace) -> None:
    """Measure how long the driver needs to store, read and summarise `count` trials."""
    from eval.judging.results import Journal, write_trials
    from eval.judging.tables import summarise

    with tempfile.TemporaryDirectory() as folder:
        path, clock = Path(folder, "journal.jsonl"), Clock()
        with Journal(path, {"policy": "p"}) as written:
            for number in range(count):
                written.append(some_trial(number))
        del written
        clock.say(f"{count} trials stored, {path.stat().st_size / MB:.0f} MB on disk", count)
        with Journal(path, {"policy": "p"}) as stored:
            results = list(stored.done.values())
        clock.say("read again", count)
        write_trials(Path(folder, "trials.parquet"), results, {})
        clock.say("written as Parquet", count)
        summarise(results)
        clock.say("summarised, with bootstrap intervals", count)


def sweep(count: int, args: argparse.Namespace) -> None:
    """Measure the load of the driver in a study of `count` vehicles with one trial each."""
    from eval.quadrotor.vehicle_file import load_vehicle
    from eval.worlds.trial import TrialSpec
    from suite.experiments.study import judging
    from suite.experiments.study.cache import Workspace

    def fly_piece(
        loaders: object, piece: Sequence[judging.Share]
    ) -> Iterator[tuple[int, TrialResult]]:
        for number, _ in piece:
            yield number, some_trial(0)

    # Flights are replaced by invented results, so that only the driver works.
    judging._fly_piece = fly_piece
    vehicle, trial, clock = load_vehicle("reference"), TrialSpec("zigzag", 0, 0), Clock()
    vehicles = (replace(vehicle, mass=vehicle.mass + 1e-6 * k) for k in range(count))
    orders = {k: judging.TrialRequest("race", one, [trial]) for k, one in enumerate(vehicles)}
    with tempfile.TemporaryDirectory() as folder:
        for action in ("flown and stored", "read from the store"):
            judging.fly_trials(orders, Workspace(Path(folder), Path(folder), 1), Silent(), "flying")
            clock.say(f"{count} vehicles {action}", count)


def costs(count: int, args: argparse.Namespace) -> None:
    """Measure a piece of each kind: its time, and the size of the data to and from a worker."""
    set_threads()
    from eval.judging.judge import Record, Task, fly_share
    from eval.quadrotor.vehicle_file import load_vehicle
    from eval.worlds.trial import TrialSpec
    from suite.blind.build import build
    from suite.blind.cases import DRAWERS
    from suite.blind.run import diagnose_by_command
    from suite.judging.content import PolicyContent
    from suite.train.recipes import named_recipe, with_iterations
    from suite.train.run import train

    content, clock = PolicyContent.of("race"), Clock()
    task = Task(content(), load_vehicle("reference"), record=Record())
    list(fly_share(task, [(0, TrialSpec("zigzag", 0, 0))]))
    clock.say("a worker's start: imports, policy, first trial")
    trials = [TrialSpec(t, n % 10, n) for t in ("zigzag", "circular") for n in range(count // 2)]
    flown = list(fly_share(task, list(enumerate(trials))))
    clock.say(f"{len(flown)} trials, recorded", len(flown))
    sent, received = len(pack(content)), len(pack([entry[:2] for entry in flown])) / len(flown)
    with_flight = len(pack(flown)) / len(flown)
    print(f"  {sent / MB:.2f} MB sent once; received {received:.0f} bytes a trial, "
          f"{with_flight / MB:.3f} MB with its flight")  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recipe = named_recipe("race-paper")
        train(with_iterations(recipe, 10), folder / "run", Silent())
        clock.say(f"a training, point mass: start, 10 of {recipe.optimizer.iterations} iterations")
        sizes = [path.stat().st_size for path in (folder / "run").rglob("*") if path.is_file()]
        print(f"  {sum(sizes) / MB:.1f} MB received")
        train(with_iterations(recipe, 30), folder / "longer", Silent())
        clock.say("the same with 30 iterations")
        case = next(iter(DRAWERS["mujoco"](0, 12).values()))
        built = build(case)
        clock.say("a blind case made")
        from eval.logs.flight_log import write_flight
        from eval.quadrotor.vehicle_file import save_vehicle

        save_vehicle(built.nominal, folder / "vehicle.toml")
        logs = [write_flight(folder / f"{log.name}.parquet", log) for log in built.logs]
        print(f"  {sum(path.stat().st_size for path in map(Path, logs)) / MB:.1f} MB of flights")
        diagnose_by_command(
            [Path(log) for log in logs], folder / "vehicle.toml", folder / "diagnosis"
        )
        clock.say("a blind case diagnosed")
        sizes = [path.stat().st_size for path in (folder / "diagnosis").rglob("*")]
        print(f"  {sum(sizes) / MB:.1f} MB received")


def main() -> None:
    """Run the measurement that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = {
        "costs": (costs, 64), "engine": (engine, 100_000), "journal": (journal, 1_000_000),
        "sweep": (sweep, 10_000),
    }  # fmt: skip
    parser.add_argument("what", choices=kinds)
    parser.add_argument("--count", type=int, help="number of pieces, trials or vehicles")
    parser.add_argument("--size", type=int, default=0, help="engine: size of a result [bytes]")
    parser.add_argument("--workers", help="engine: N processes of this machine, or ADDRESS")
    args = parser.parse_args()
    measure, count = kinds[args.what]
    measure(args.count or count, args)


if __name__ == "__main__":
    main()
