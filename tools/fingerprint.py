"""Compute digests of the suite's results, to check that a refactoring keeps them equal to the bit.

Run it before and after a change, on the same machine, and compare the two files:

    python tools/fingerprint.py --out before.json --work runs/fingerprint-before
    python tools/fingerprint.py --out after.json --work runs/fingerprint-after
    python tools/fingerprint.py --compare before.json after.json

It uses commands only, so that it does not depend on the layout of the code. It computes digests of:

- trials of the shipped policies (levels 0 and 9),
- the weights after a few gradient steps, for every recipe and for both dynamics,
- a Delta Action Model (a network that corrects actions), for both dynamics,
- the result of `suite identify` on simulated flights,
- the diagnosis of 20 blind cases (flights with hidden effects).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Container
from pathlib import Path
from typing import Any

import numpy as np

POLICIES = ("race", "race-small", "race-paper")
"""Policies that fly in MuJoCo."""
RECIPES = ("race", "race-small", "race-paper", "paper")
"""Recipes of the trainings."""
MJX_POLICIES = ("race-paper", "race")
"""Policies that also fly in MJX, which takes longer."""
STAMPS = ("version", "commit", "git_commit", "schema", "created", "seconds", "out")
"""Keys that may differ between two versions of the code with equal results."""
FOLDERS = re.compile(r"[^\s'\"(]*/(?=[^/\s]*\.[a-z])")
"""The folders of a file in a text: they differ between two runs; units such as m/s stay."""


def suite(*args: str | Path) -> None:
    """Run a command of the suite that is installed next to this Python.

    Raises:
        subprocess.CalledProcessError: if the command fails.
    """
    program = Path(sys.executable).with_name("suite")
    subprocess.run([program, *map(str, args)], check=True, stdout=subprocess.DEVNULL)


def array_digest(arrays: dict[str, np.ndarray]) -> str:
    """Return the SHA-256 of the names, types, shapes and bytes of arrays."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


def parquet_digest(path: Path) -> str:
    """Return the digest of a table's columns, without its metadata."""
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    text = json.dumps({name: table[name].to_pylist() for name in sorted(table.column_names)})
    return hashlib.sha256(text.encode()).hexdigest()


def weights_digest(folder: Path) -> str:
    """Return the digest of all weights in a checkpoint's folder."""
    from safetensors.numpy import load_file

    files = sorted(folder.rglob("*.safetensors"))
    return array_digest({f"{f.name}/{k}": v for f in files for k, v in load_file(f).items()})


def json_digest(path: Path, ignored: Container[str] = STAMPS) -> str:
    """Return the digest of a JSON or JSON Lines file without the keys `ignored`."""

    def without_stamps(value: Any) -> Any:
        """Return contents of a JSON file without `ignored`, and of files only the name."""
        if isinstance(value, dict):
            return {k: without_stamps(v) for k, v in value.items() if k not in ignored}
        if isinstance(value, str):
            return FOLDERS.sub("", value)
        return [without_stamps(v) for v in value] if isinstance(value, list) else value

    text = path.read_text()
    rows = text.splitlines() if path.suffix == ".jsonl" else [text]
    text = "".join(json.dumps(without_stamps(json.loads(row)), sort_keys=True) for row in rows)
    return hashlib.sha256(text.encode()).hexdigest()


def trials(work: Path) -> dict[str, str]:
    """Return the digests of 30 trials for each policy and simulator."""
    digests = {}
    for world, policies in (("mujoco", POLICIES), ("mjx", MJX_POLICIES)):
        for policy in policies:
            out = work / f"eval-{world}-{policy}"
            suite("eval", "--policy", policy, "--simulator", world, "--difficulty", "0,9",
                  "--trials", "5", "--workers", "1", "--out", out)  # fmt: skip
            digests[f"trials {world} {policy}"] = parquet_digest(out / "trials.parquet")
    return digests


def training(work: Path) -> dict[str, str]:
    """Return the digests of the weights after a few gradient steps, for each recipe and model."""
    digests = {}
    for recipe in RECIPES:
        out = work / f"train-{recipe}"
        suite("train", "--recipe", recipe, "--iterations", "3", "--out", out,
              "--set", "episode.batch=4")  # fmt: skip
        digests[f"training {recipe}"] = weights_digest(out / "policy")
    for model in ("point", "quad"):
        out = work / f"train-{model}"
        vehicle = ("--vehicle", "racer5") if model == "quad" else ()
        batch = ("--set", "episode.batch=8") if model == "quad" else ()
        suite("train", "--recipe", "quick", "--iterations", "20", "--model", model, "--out", out,
              *vehicle, *batch)  # fmt: skip
        digests[f"training {model}"] = weights_digest(out / "policy")
    return digests


def delta(work: Path) -> dict[str, str]:
    """Return the digests of flights, and of a Delta Action Model in each of the two dynamics."""
    flights = work / "flights"
    suite("collect", "--policy", "race-paper", "--trials", "2", "--out", flights)
    digests = {"flights": "".join(parquet_digest(f)[:8] for f in sorted(flights.glob("*.parquet")))}
    for model in ("point", "quad"):
        out = work / f"delta-{model}"
        vehicle = ("--vehicle", "racer5") if model == "quad" else ()
        suite("delta", flights, "--model", model, *vehicle, "--recipe", "quick",
              "--iterations", "30", "--out", out)  # fmt: skip
        digests[f"delta {model}"] = weights_digest(out / "delta")
    return digests


def diagnosis(work: Path) -> dict[str, str]:
    """Return the digests of the logs and of the diagnosis of about 20 blind cases."""
    out = work / "blind"
    suite("blind", "make", "--seed", "424242", "--count", "20", "--out", out)
    digests = {
        f"blind log {f.parent.name}/{f.stem}": parquet_digest(f)
        for f in sorted((out / "cases").rglob("*.parquet"))
    }
    suite("blind", "run", "--out", out)
    for path in sorted(out.rglob("diagnosis.json")):
        digests[f"diagnosis {path.parent.name}"] = json_digest(path)
    return digests


def identify(work: Path) -> dict[str, str]:
    """Return the digest of the vehicle file that `suite identify` estimates from four flights."""
    flights, out = work / "identify-flights", work / "identified.toml"
    suite("collect", "--policy", "race-paper", "--trials", "4", "--vehicle", "reference",
          "--out", flights)  # fmt: skip
    suite("identify", *sorted(flights.glob("*.parquet")), "--vehicle", "racer5", "--out", out)
    lines = [line for line in out.read_text().splitlines() if not line.startswith("#")]
    return {"identify": hashlib.sha256("\n".join(lines).encode()).hexdigest()}


PARTS: dict[str, Callable[[Path], dict[str, str]]] = {
    "trials": trials,
    "training": training,
    "delta": delta,
    "identify": identify,
    "diagnosis": diagnosis,
}
"""Part of the suite -> function (working folder) -> digests by name."""


def compare(before: Path, after: Path) -> int:
    """Print the names that differ between two files of digests, and return 1 if there are any."""
    old, new = (json.loads(path.read_text()) for path in (before, after))
    different = [name for name in sorted(old | new) if old.get(name) != new.get(name)]
    for name in different:
        print(f"differs: {name}")
    print(f"{len(old | new) - len(different)} of {len(old | new)} the same to the bit")
    return int(bool(different))


def main() -> int:
    """Write the digests, or compare two files of them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("fingerprint.json"))
    parser.add_argument("--work", type=Path, default=Path("runs/fingerprint"))
    parser.add_argument("--only", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("BEFORE", "AFTER"))
    options = parser.parse_args()
    if options.compare:
        return compare(*options.compare)
    digests: dict[str, str] = {}
    for part in options.only:
        shutil.rmtree(options.work / part, ignore_errors=True)
        digests |= PARTS[part](options.work / part)
        options.out.write_text(json.dumps(digests, indent=1) + "\n")
        print(f"{part}: done", file=sys.stderr, flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
