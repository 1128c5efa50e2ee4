"""What a piece costs, and what a driver can take: docs/scaling.md's figures.

    python tools/pieces.py costs                          one piece of each kind, in this process
    python tools/pieces.py engine --count 100000          a cluster of two workers, made for it
    python tools/pieces.py engine --workers 2             processes here, or a cluster's address
    python tools/pieces.py journal --count 1000000
    python tools/pieces.py sweep --count 10000

Only `costs` works in earnest. The pieces of `engine` do nothing and the trials of `journal` and
`sweep` are copies of one: what is measured is what the driver does for each. Seconds are those of
the processor where not said otherwise.
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

from suite.common.work import Silent
from tracks.common.work import Workers, read_workers, run_pieces
from tracks.common.work.pickling import pack
from tracks.common.work.threads import set_threads

if TYPE_CHECKING:
    from eval.worlds.trial import TrialResult

MB = 1e6
SHOWN = 10_000


class Clock:
    """Time since its last line."""

    def __init__(self) -> None:
        self.wall, self.busy = time.monotonic(), _spent_s()

    def say(self, what: str, count: int = 1) -> None:
        """Print what was done `count` times since, and what it took."""
        wall, busy = time.monotonic() - self.wall, _spent_s() - self.busy
        each = f", {1e6 * busy / count:.0f} us each" if count > 1 else ""
        print(f"{what}: {busy:.1f} s ({wall:.1f} s wall){each}; {memory_mb():.0f} MB", flush=True)
        self.wall, self.busy = time.monotonic(), _spent_s()


def _spent_s() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def memory_mb() -> float:
    """Return what this process holds [MB]."""
    return psutil.Process().memory_info().rss / MB


def nothing(size: int, piece: int) -> Iterator[bytes]:
    """Yield so many bytes for a piece."""
    yield bytes(size)


@contextlib.contextmanager
def workers_of(text: str | None) -> Iterator[Workers]:
    """Yield the workers asked for, or those of a cluster on this machine while it is used."""
    if text:
        yield read_workers(text) or 1
        return
    from distributed import LocalCluster

    made: Any = LocalCluster
    with made(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        print(f"scheduler and two workers on {os.cpu_count()} cores")
        yield cluster.scheduler_address


def engine(count: int, args: argparse.Namespace) -> None:
    """Send pieces that do nothing."""
    with workers_of(args.workers) as workers:
        done, clock, started = 0, Clock(), time.monotonic()

        def keep(number: int, result: bytes) -> None:
            nonlocal done
            done += 1
            if done % SHOWN == 0:
                rate = done / (time.monotonic() - started)
                print(f"{done}: {rate:.0f} a second, {memory_mb():.0f} MB", flush=True)

        run_pieces(partial(nothing, args.size), range(count), workers, keep)
        clock.say(f"{done} pieces of {args.size} bytes, of the driver", done)
        for process in psutil.Process().children(recursive=True):
            with contextlib.suppress(psutil.Error):
                spent = sum(process.cpu_times()[:2])
                print(f"  {process.name()}: {spent:.1f} s, {process.memory_info().rss / MB:.0f} MB")


def some_trial(number: int) -> TrialResult:
    """Return a trial that was never flown."""
    from eval.worlds.trial import TrialResult

    rest = dict.fromkeys(TrialResult._fields[-5:], 0)
    return TrialResult(
        "zigzag", number % 10, number, "p", "v", "mujoco", True, 8, "finished", None,
        0.123456789, 0.2, 0.3, 5.0, 4.0, 3.0, **rest,
    )  # fmt: skip


def journal(count: int, args: argparse.Namespace) -> None:
    """Keep trials, read them again, write the table's files."""
    from eval.judging.results import Journal, write_trials
    from eval.judging.tables import summarise

    with tempfile.TemporaryDirectory() as folder:
        path, clock = Path(folder, "journal.jsonl"), Clock()
        with Journal(path, {"policy": "p"}) as kept:
            for number in range(count):
                kept.append(some_trial(number))
        del kept
        clock.say(f"{count} trials kept, {path.stat().st_size / MB:.0f} MB on the disk", count)
        with Journal(path, {"policy": "p"}) as again:
            results = list(again.done.values())
        clock.say("read again", count)
        write_trials(Path(folder, "trials.parquet"), results, {})
        clock.say("written as Parquet", count)
        summarise(results)
        clock.say("summed up, with bootstrap intervals", count)


def sweep(count: int, args: argparse.Namespace) -> None:
    """Order a trial of each of many vehicles, and keep what came."""
    from eval.quadrotor.vehicle_file import load_vehicle
    from eval.worlds.trial import TrialSpec
    from suite.experiments.study import judging
    from suite.experiments.study.cache import Place

    def piece(
        loaders: judging.Loaders, shares: Sequence[judging.Share]
    ) -> Iterator[tuple[int, TrialResult]]:
        for share in shares:
            yield share.number, some_trial(0)

    judging._fly_piece = piece
    vehicle, trial, clock = load_vehicle("reference"), TrialSpec("zigzag", 0, 0), Clock()
    setups = (
        judging.Setup("race", replace(vehicle, mass=vehicle.mass + 1e-6 * k)) for k in range(count)
    )
    orders = {k: judging.Order(setup, [trial]) for k, setup in enumerate(setups)}
    with tempfile.TemporaryDirectory() as folder:
        for what in ("ordered and kept", "found again"):
            judging.flown(orders, Place(Path(folder), Path(folder), 1), Silent(), "flying")
            clock.say(f"{count} vehicles {what}", count)


def costs(count: int, args: argparse.Namespace) -> None:
    """Work a piece of each kind off, and say what goes there and comes back."""
    set_threads()
    from eval.judging.judge import Record, Task, fly_share
    from eval.quadrotor.vehicle_file import load_vehicle
    from eval.worlds.trial import TrialSpec
    from suite.blind.build import build
    from suite.blind.cases import DRAWERS
    from suite.blind.run import by_command
    from suite.judging.content import PolicyContent
    from suite.train.recipes import named_recipe, with_iterations
    from suite.train.run import train

    content, clock = PolicyContent.of("race"), Clock()
    task = Task(content(), load_vehicle("reference"), record=Record())
    list(fly_share(task, [(0, TrialSpec("zigzag", 0, 0))]))
    clock.say("a worker's start: imports, policy, first trial")
    levels = [TrialSpec(t, n % 10, n) for t in ("zigzag", "circular") for n in range(count // 2)]
    ended = list(fly_share(task, list(enumerate(levels))))
    clock.say(f"{len(ended)} trials, recorded", len(ended))
    there, back = len(pack(content)), len(pack([entry[:2] for entry in ended])) / len(ended)
    flight = len(pack(ended)) / len(ended)
    print(f"  {there / MB:.2f} MB there once; back {back:.0f} bytes a trial, "
          f"{flight / MB:.3f} MB with its flight")  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = with_iterations(named_recipe("race"), 10)
        train(config, folder / "run", Silent())
        clock.say("a training of race: start and 10 of 2,000 iterations")
        sizes = [path.stat().st_size for path in (folder / "run").rglob("*") if path.is_file()]
        print(f"  {sum(sizes) / MB:.1f} MB back")
        train(with_iterations(named_recipe("race"), 30), folder / "longer", Silent())
        clock.say("the same with 30 iterations")
        case = next(iter(DRAWERS["mujoco"](0, 12).values()))
        built = build(case)
        clock.say("a blind case made")
        from eval.logs.flight_log import write_flight
        from eval.quadrotor.vehicle_file import save_vehicle

        save_vehicle(built.nominal, folder / "vehicle.toml")
        logs = [write_flight(folder / f"{log.name}.parquet", log) for log in built.logs]
        print(f"  {sum(path.stat().st_size for path in map(Path, logs)) / MB:.1f} MB of flights")
        by_command([Path(log) for log in logs], folder / "vehicle.toml", folder / "diagnosis")
        clock.say("a blind case diagnosed")
        sizes = [path.stat().st_size for path in (folder / "diagnosis").rglob("*")]
        print(f"  {sum(sizes) / MB:.1f} MB back")


def main() -> None:
    """Run one measurement."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = {
        "costs": (costs, 64), "engine": (engine, 100_000), "journal": (journal, 1_000_000),
        "sweep": (sweep, 10_000),
    }  # fmt: skip
    parser.add_argument("what", choices=kinds)
    parser.add_argument("--count", type=int, help="pieces, trials or vehicles")
    parser.add_argument("--size", type=int, default=0, help="of a result of engine [bytes]")
    parser.add_argument("--workers", help="of engine: N processes of this machine, or ADDRESS")
    args = parser.parse_args()
    do, count = kinds[args.what]
    do(args.count or count, args)


if __name__ == "__main__":
    main()
