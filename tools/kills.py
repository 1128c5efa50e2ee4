"""Test that commands continue after kill -9 at random times, and give the same bits.

    python tools/kills.py COUNT [COMMAND ...] [--seed N]
    python tools/kills.py COUNT --signals [--seed N]

Every command of `COMMANDS` first runs undisturbed. Then it is run COUNT times. Each of these runs
is killed at a random time and started again, up to six times, and then runs to its end. Its files
must equal those of the undisturbed run, except for times and stamps. The tool prints a line for
each run, and fails if the files of one differ. A kill counts only if the command was still running.

With --signals the tool tests COUNT trainings instead, without stored compiled code. Each gets
Ctrl-C or SIGTERM at a random time of its first 20 s. The tool fails if one of them does not end
with exit code 130 within 5 s.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from fingerprint import json_digest, parquet_digest

EASY = "--track zigzag --difficulty 0"
"""Options of short flights."""
WORLDS = "episode.batch=8 episode.steps=30"
"""Settings of a small training."""
COMMANDS = {
    "train": f"train --recipe quick --iterations 60 --set {WORLDS}",
    "eval": f"eval --policy race-paper --trials 12 {EASY}",
    "collect": f"collect --policy race-paper --trials 12 {EASY}",
    "delta": "delta FLIGHTS --iterations 60",
    "diagnose": "diagnose suite/diagnose/example --vehicle suite/diagnose/example/vehicle.toml",
    "loop": f"loop --recipe quick --iterations 6 --finetune-iterations 3 --fit-iterations 10 "
    f"--trials 2 --flights 2 {EASY} --set {WORLDS}",
}
"""Name -> command without --out; FLIGHTS stands for the folder of the recorded flights."""
COMPARED = ("*.safetensors", "*.parquet", "metrics.jsonl", "diagnosis.json", "flights.json")
"""Patterns of the files of a run that are compared."""
SHARES = (1.0, 0.5, 0.5, 0.5, 0.5, 0.5)
"""Latest time of the first, second, ... kill of a run, as a share of the duration of an undisturbed
run."""
IGNORED_KEYS = ("seconds", "steps_per_s", "cold", "git_commit", "out", "collection", "source")
"""Keys of JSON files that differ between equal runs: times and folders."""
WITHIN_S = 5.0
"""Longest time from a signal to the end of the command [s]."""
LONGEST_S = 1800.0
"""Time after which a command has failed: it is killed then [s]."""


def start(command: str, out: Path) -> subprocess.Popen[bytes]:
    """Start a command that writes to `out`, a folder `COMMAND/RUN` in the temporary folder."""
    words = COMMANDS[command].replace("FLIGHTS", str(out.parents[1] / "collect" / "plain")).split()
    args = [sys.executable, "-m", "suite.cli", *words, "--out", str(out)]
    return subprocess.Popen(args, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def digest(out: Path) -> str:
    """Return the SHA-256 (16 digits) of the compared files of a run; "nothing" without files."""
    sums = hashlib.sha256()
    paths = {path for pattern in COMPARED for path in out.rglob(pattern)}
    for path in sorted(paths):
        sums.update(f"{path.relative_to(out)}\0".encode() + _content(path))
    return sums.hexdigest()[:16] if paths else "nothing"


def _content(path: Path) -> bytes:
    """Return the contents of weights, or the digest of another file without its stamps."""
    if path.suffix == ".parquet":
        return parquet_digest(path).encode()
    if path.suffix in (".json", ".jsonl"):
        return json_digest(path, IGNORED_KEYS).encode()
    return path.read_bytes()


def finish(command: str, out: Path) -> float:
    """Run a command to its end and return its duration [s].

    Raises:
        SystemExit: if the command fails, or does not end within `LONGEST_S`.
    """
    start_s = time.monotonic()
    process = start(command, out)
    try:
        _, output = process.communicate(timeout=LONGEST_S)
    except subprocess.TimeoutExpired:
        process.kill()
        raise SystemExit(f"{command} did not end within {LONGEST_S:g} s") from None
    if process.returncode:
        raise SystemExit(f"{command} ended with {process.returncode}: {output.decode()[-500:]}")
    return time.monotonic() - start_s


def start_and_kill(command: str, out: Path, after_s: float) -> bool:
    """Start a command, kill it after a time, and return whether it was still running."""
    process = start(command, out)
    try:
        process.communicate(timeout=after_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return True
    return False


def start_and_signal(number: signal.Signals, after_s: float) -> tuple[int, float]:
    """Start a training, and send it a signal after the time `after_s` [s].

    Returns:
        The exit code of the training, and the time from the signal to its end [s]. A training that
        does not end is killed.
    """
    with tempfile.TemporaryDirectory() as folder:
        training = subprocess.Popen(
            [sys.executable, "-m", "suite.cli", *COMMANDS["train"].split(), "--out", folder],
            env={**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "false"},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            # Background jobs of a shell ignore Ctrl-C, and a child process inherits that.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        time.sleep(after_s)
        sent_s = time.monotonic()
        training.send_signal(number)
        try:
            code = training.wait(4 * WITHIN_S)
        except subprocess.TimeoutExpired:
            training.kill()
            code = training.wait()
        return code, time.monotonic() - sent_s


def send_signals(count: int, rng: random.Random) -> int:
    """Test `count` trainings that get a signal, and return the exit code of the tool."""
    failures = 0
    for _ in range(count):
        number, after_s = rng.choice([signal.SIGINT, signal.SIGTERM]), rng.uniform(1.5, 20.0)
        code, duration_s = start_and_signal(number, after_s)
        failures += code != 130 or duration_s > WITHIN_S
        print(f"{number.name} after {after_s:.1f} s: {code}, {duration_s:.1f} s later", flush=True)
    print(f"{count - failures} of {count} ended with 130 within {WITHIN_S:g} s")
    return min(failures, 1)


def main() -> int:
    """Test the commands of the command line, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int)
    parser.add_argument("commands", nargs="*", default=list(COMMANDS), metavar="COMMAND")
    parser.add_argument("--signals", action="store_true", help="Ctrl-C and SIGTERM instead")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng, failures, kills = random.Random(args.seed), 0, 0
    if args.signals:
        return send_signals(args.count, rng)
    with tempfile.TemporaryDirectory() as folder:
        if "delta" in args.commands and "collect" not in args.commands:
            finish("collect", Path(folder, "collect", "plain"))
        # In the order of the table, as `delta` needs the flights of `collect`.
        for command in sorted(args.commands, key=list(COMMANDS).index):
            plain = Path(folder, command, "plain")
            finish(command, plain)
            # The duration is that of a second run, whose compiled code is stored.
            duration_s = finish(command, Path(folder, command, "warm"))
            expected = digest(plain)
            for number in range(args.count):
                out, times_s = Path(folder, command, str(number)), []
                for share in SHARES:
                    time_s = rng.uniform(0.3, share * duration_s)
                    if not start_and_kill(command, out, time_s):
                        break
                    times_s.append(time_s)
                kills += len(times_s)
                finish(command, out)
                # Hidden files are temporary ones, which the finished command must have removed.
                same = digest(out) == expected
                temporary = sorted(path.name for path in out.rglob(".*"))
                failures += not same or bool(temporary)
                times = ", ".join(f"{time_s:.1f}" for time_s in times_s)
                result = "same bits" if same else "OTHER BITS"
                result += f", temporary files {temporary}" if temporary else ""
                print(
                    f"{command}, killed after {times} of {duration_s:.1f} s: {result}", flush=True
                )
    print(f"{kills} kills, {failures} runs that differ")
    return min(failures, 1)


if __name__ == "__main__":
    raise SystemExit(main())
