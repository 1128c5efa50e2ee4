"""kill -9 at random moments: does the same command go on, and come to the same bits?

    python tools/kills.py COUNT [COMMAND ...] [--seed N]
    python tools/kills.py COUNT --signals [--seed N]

Every command of the table below runs without a disturbance; then COUNT times it is killed at a
random moment of the time that took, and up to five times more, sooner, after it was called again,
and then left to end. What it wrote must be equal to the undisturbed run's, but for times and
stamps. Prints a line a run and fails where one differs. Only what was killed while it ran counts.

With --signals a training without compiled code is sent Ctrl-C or SIGTERM instead, COUNT times at a
random moment of its first 20 s. It fails where one does not end with 130 within 5 s.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

EASY = "--track zigzag --difficulty 0"
WORLDS = "episode.batch=8 episode.steps=30"
COMMANDS = {
    "train": f"train --recipe quick --iterations 60 --set {WORLDS}",
    "eval": f"eval --policy race-paper --trials 12 {EASY}",
    "collect": f"collect --policy race-paper --trials 12 {EASY}",
    "delta": "delta FLIGHTS --iterations 60",
    "diagnose": "diagnose suite/diagnose/example --vehicle suite/diagnose/example/vehicle.toml",
    "loop": f"loop --recipe quick --iterations 6 --finetune-iterations 3 --fit-iterations 10 "
    f"--trials 2 --flights 2 {EASY} --set {WORLDS}",
}
"""What is killed, without its --out; FLIGHTS is a folder of recorded ones."""
COMPARED = ("*.safetensors", "*.parquet", "metrics.jsonl", "diagnosis.json", "flights.json")
SHARES = (1.0, 0.5, 0.5, 0.5, 0.5, 0.5)
"""Up to which share of a whole run's time each of its kills comes."""
TIMES = ("seconds", "steps_per_s", "cold", "git_commit", "out", "collection", "source")
"""Keys that differ between runs that are alike: times, and the folders of what a loop made."""
WITHIN_S = 5.0
"""A signal is answered in this time [s]."""


def start(command: str, out: Path) -> subprocess.Popen[bytes]:
    """Start a command with its files in `out`, two folders below that of all."""
    words = COMMANDS[command].replace("FLIGHTS", str(out.parents[1] / "collect" / "plain")).split()
    args = [sys.executable, "-m", "suite.cli", *words, "--out", str(out)]
    return subprocess.Popen(args, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def digest(out: Path) -> str:
    """Return what a run came to, as one number."""
    sums = hashlib.sha256()
    paths = {path for pattern in COMPARED for path in out.rglob(pattern)}
    for path in sorted(paths):
        sums.update(f"{path.relative_to(out)}\\0".encode() + _content(path))
    return sums.hexdigest()[:16] if paths else "nothing"


def _content(path: Path) -> bytes:
    if path.suffix == ".parquet":
        import pyarrow.parquet

        return repr(pyarrow.parquet.ParquetFile(path).read().to_pydict()).encode()
    if path.suffix == ".json":
        return json.dumps(_timeless(json.loads(path.read_text()))).encode()
    if path.suffix == ".jsonl":
        rows = path.read_text().splitlines()
        return json.dumps([_timeless(json.loads(row)) for row in rows]).encode()
    return path.read_bytes()


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(entry) for key, entry in value.items() if key not in TIMES}
    return [_timeless(entry) for entry in value] if isinstance(value, list) else value


def finish(command: str, out: Path) -> float:
    """Run a command to its end and return how long it took [s]."""
    began = time.monotonic()
    process = start(command, out)
    _, said = process.communicate()
    if process.returncode:
        raise SystemExit(f"{command} ended with {process.returncode}: {said.decode()[-500:]}")
    return time.monotonic() - began


def killed(command: str, out: Path, after_s: float) -> bool:
    """Start a command, kill it after a time and say whether it still ran."""
    process = start(command, out)
    try:
        process.communicate(timeout=after_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return True
    return False


def signalled(number: signal.Signals, after_s: float) -> tuple[int, float]:
    """Return the exit code of a training that gets a signal, and how long after [s]."""
    with tempfile.TemporaryDirectory() as folder:
        training = subprocess.Popen(
            [sys.executable, "-m", "suite.cli", *COMMANDS["train"].split(), "--out", folder],
            env={**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "false"},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            # A shell has background jobs ignore Ctrl-C, and what ignores it ends by nothing else.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        time.sleep(after_s)
        sent = time.monotonic()
        training.send_signal(number)
        return training.wait(), time.monotonic() - sent


def send_signals(count: int, draw: random.Random) -> int:
    """Send so many signals and return the exit code."""
    bad = 0
    for _ in range(count):
        number, after_s = draw.choice([signal.SIGINT, signal.SIGTERM]), draw.uniform(1.5, 20.0)
        code, took_s = signalled(number, after_s)
        bad += code != 130 or took_s > WITHIN_S
        print(f"{number.name} after {after_s:.1f} s: {code}, {took_s:.1f} s later", flush=True)
    print(f"{count - bad} of {count} ended with 130 within {WITHIN_S:g} s")
    return min(bad, 1)


def main() -> int:
    """Kill or interrupt what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int)
    parser.add_argument("commands", nargs="*", default=list(COMMANDS), metavar="COMMAND")
    parser.add_argument("--signals", action="store_true", help="Ctrl-C and SIGTERM instead")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    draw, bad, tried = random.Random(args.seed), 0, 0
    if args.signals:
        return send_signals(args.count, draw)
    with tempfile.TemporaryDirectory() as folder:
        if "delta" in args.commands and "collect" not in args.commands:
            finish("collect", Path(folder, "collect", "plain"))
        # Flights first: what is fitted to them finds them.
        for command in sorted(args.commands, key=list(COMMANDS).index):
            plain = Path(folder, command, "plain")
            finish(command, plain)
            took_s, wanted = finish(command, Path(folder, command, "warm")), digest(plain)
            for number in range(args.count):
                out, moments = Path(folder, command, str(number)), []
                for share in SHARES:
                    moment = draw.uniform(0.3, share * took_s)
                    if not killed(command, out, moment):
                        break
                    moments.append(moment)
                tried += len(moments)
                finish(command, out)
                same = digest(out) == wanted
                left = sorted(path.name for path in out.rglob(".*"))
                bad += not same or bool(left)
                when = ", ".join(f"{moment:.1f}" for moment in moments)
                said = ("same bits" if same else "OTHER BITS") + (f", left {left}" if left else "")
                print(f"{command}, killed after {when} of {took_s:.1f} s: {said}", flush=True)
    print(f"{tried} kills, {bad} runs that differ")
    return min(bad, 1)


if __name__ == "__main__":
    raise SystemExit(main())
