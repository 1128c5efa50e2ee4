"""Plant faults in the code one at a time, and count how many of them the tests catch.

    python tools/plant_faults.py [--tree DIR] [--out FILE.json] [--only NUMBER ...] [--list]

A fault replaces a text of the code by a wrong one, such as another sign, axis, row, term, unit or
threshold. The text must occur exactly once below the folder of the fault. Each fault has a list of
tests. They run in a copy of the files that git tracks in DIR, first without the fault, then with
it. The fault is caught if a test fails. The same command continues after an interruption. The exit
code is 1 if a fault was not caught.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parent.parent
"""Folder of the checkout."""
LONGEST_S = 300.0
"""Longest duration of the tests of a fault [s]. If they run longer with the fault, it is caught."""
FAILED = 1
"""Exit code of pytest if a test fails."""


class Fault(NamedTuple):
    """One planted fault."""

    folder: str
    """Folder of the code in which the text occurs once."""
    old: str
    """Correct text, as in the code."""
    new: str
    """Wrong text that replaces it."""
    tests: str
    """Test files that should catch the fault: the ends of their paths, without .py. At least one of
    the files must exist."""


FAULTS = (
    # tracks: field, gates, cameras, solids
    Fault("tracks", "return ((1 - aligned) / xp.max", "return ((1 + aligned) / xp.max",
          "test_geometry"),
    Fault("tracks", "fraction = -before[..., 0] /", "fraction = before[..., 0] /", "test_geometry"),
    Fault(
        "tracks", "2 * (xy - wz), 2 * (xz + wy)",
        "2 * (xy + wz), 2 * (xz + wy)", "test_geometry",
    ),
    Fault(
        "tracks", "half_u * (1 - (2 * np.arange(camera.width) + 1) /",
        "half_u * (1 - (2 * np.arange(camera.width)) /", "test_geometry",
    ),
    Fault(
        "tracks", "along = jnp.clip((away * rods.axis_w).sum(-1), -rods",
        "along = jnp.clip((away * rods.axis_w).sum(-1), 0.0 * rods",
        "geometry/test_depth",
    ),
    Fault("tracks", "center_w, angle + turn * np.pi / 2", "center_w, angle + np.pi / 2",
          "test_families"),
    # policies: networks, observation, C
    Fault("policies", "new + update * (hidden - new)", "hidden + update * (new - hidden)",
          "test_network"),
    Fault("policies", "numbers = [vel_b, rot_w[..., 2, :]", "numbers = [vel_b, rot_w[..., :, 2]",
          "test_observation"),
    Fault("policies", "x < -8.0f ? -8.0f : x > 8.0f ? 8.0f : x", "x", "test_c"),
    Fault("policies", "math.log(new.rate_hz / old.rate_hz)",
          "math.log(old.rate_hz / new.rate_hz)", "test_network"),
    Fault("policies", "range_m) - encoding.offset", "range_m) + encoding.offset",
          "test_observation"),
    Fault("policies", "-zero * column_sum", "zero * column_sum", "test_c"),
    # eval: effects, quadrotor
    Fault("eval/effects", "-per_axis(flow.constants.mass) * values.coefficient * flow.air_vel_b",
          "-values.coefficient * flow.air_vel_b", "test_equations"),
    Fault("eval/effects", "/ (4.0 * height)) ** 2", "/ (2.0 * height)) ** 2", "test_equations"),
    Fault("eval/effects", "constants.rotor_position_b - values.offset[",
          "constants.rotor_position_b + values.offset[", "test_equations test_effects"),
    Fault("eval/quadrotor", "(rate_cmd_b - rate_b) + cross(", "(rate_cmd_b - rate_b) - cross(",
          "quadrotor/test_rotors test_stepper test_quadrotor"),
    Fault("eval/quadrotor", "steps * (1.0 - decay**2)", "steps * (1.0 - decay)", "test_rotors"),
    Fault("eval/quadrotor", "xp.where(age == full + 1.0, fraction",
          "xp.where(age == full - 1.0, fraction",
          "quadrotor/test_rotors"),
    Fault("eval/quadrotor", "xp.where(known, hx * gy - hy * gx, 0.0)",
          "xp.where(known, hy * gx - hx * gy, 0.0)", "test_attitude"),
    # eval: units of importers
    Fault("eval/importers", '0.01, "V": 1.0, "mV": 1e-3}', '0.01, "V": 1.0, "mV": 1e-2}',
          "importers/test_foreign importers/test_frames"),
    Fault("eval/importers", '"Hz": float(2.0 * np.pi)', '"Hz": float(np.pi)',
          "importers/test_mapping importers/test_frames"),
    Fault("eval/importers", '"mrad/s": 1e-3', '"mrad/s": 1e-2',
          "importers/test_mapping importers/test_frames"),
    # eval: judging, statistics
    Fault("eval/worlds", "xp.where(live_without_contact & (rot_w[:, 2, 2] < 0), TIPPED",
          "xp.where(live_without_contact & (rot_w[:, 2, 2] < 0.05), TIPPED", "test_trial"),
    Fault("eval/worlds", "progress.step <= short_step, gates", "progress.step < short_step, gates",
          "test_trial"),
    Fault("eval/judging", "np.rint(step[place + 1] - ages)",
          "np.floor(step[place + 1] - ages)", "test_ages"),
    Fault("eval/judging", "+ (z / (2 * trials)) ** 2)", "+ (z / trials) ** 2)", "test_statistics"),
    # suite: losses, gradient, point mass
    Fault("suite/train", "jnp.maximum(1.0 - step.margin, 0.0) ** 2",
          "jnp.maximum(1.0 + step.margin, 0.0) ** 2", "test_losses"),
    Fault("suite/train", "-(jax.lax.stop_gradient(pull) * (step.pos_w - fixed_pos))",
          "(jax.lax.stop_gradient(pull) * (step.pos_w - fixed_pos))", "test_losses"),
    Fault("suite/train", "return x * factor + jax.lax.stop_gradient(x * (1 - factor))",
          "return x * (1 - factor) + jax.lax.stop_gradient(x * factor)", "test_point_mass"),
    Fault("suite/train", "stride * cotangents)", "1.0 * cotangents)", "test_rollout"),
    Fault("suite/train", "error = reward + discount * going * value[1:] - value[:-1]",
          "error = reward + discount * value[1:] - value[:-1]", "test_ppo"),
    # suite: Delta Action Model
    Fault("suite/delta", "mean_norm(pos - windows.pos_w[:, 1:])",
          "mean_norm(pos - windows.pos_w[:, :-1])", "delta/test_fit"),
    Fault("suite/delta", "optax.adam(optax.cosine_decay_schedule(config.rate, iterations))",
          "optax.adam(config.rate)", "delta/test_fit"),
    Fault("suite/delta", "np.where(up[..., 2:] < 0, -forward, forward)", "forward",
          "delta/test_windows"),
    # suite: diagnosis
    Fault("suite/diagnose", "(slow**2).sum(axis=(2, 3)) - (explained**2).sum(axis=(2, 3))",
          "(slow**2).sum(axis=(2, 3))", "diagnose/evidence/test_rollouts"),
    Fault("suite/diagnose", "float((1 + as_extreme.sum()) / (1 + len(as_extreme)))",
          "float(as_extreme.sum() / (1 + len(as_extreme)))", "diagnose/search/test_search"),
    # suite: blind cases, link
    Fault("suite/blind", "return vector[:, [1, 0, 2]] * [1.0, -1.0, 0.0]",
          "return vector[:, [1, 0, 2]] * [-1.0, 1.0, 0.0]", "continuous/test_engine"),
    Fault("suite/blind", "yield bool(span[0] <= true <= span[1])", "yield bool(true <= span[1])",
          "test_score"),
    Fault("suite/judging/link", "np.asarray(quat_wxyz, float) * QUAT_HALF_TURN",
          "np.asarray(quat_wxyz, float) * [1.0, -1.0, 1.0, -1.0]", "test_link"),
    Fault("suite/judging/link", "since_s + limits.jump_m", "since_s + 2.0 * limits.jump_m",
          "test_companion"),
)  # fmt: skip
"""The forty faults: 6 in tracks, 6 in policies, 14 in eval, 14 in suite."""


def copy_tree(tree: Path, place: Path) -> list[str]:
    """Copy the files that git tracks in `tree` to `place`, and return their names."""
    listed = subprocess.run(
        ["git", "-C", str(tree), "ls-files", "-z"], check=True, capture_output=True, text=True
    )
    names = [name for name in listed.stdout.split("\0") if (tree / name).is_file()]
    for name in names:
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(tree / name, place / name)
    return names


def place_of(fault: Fault, names: list[str], copy: Path) -> Path:
    """Return the file that has the text of the fault.

    `names` are paths relative to the checkout, and `copy` is the folder with the copies.

    Raises:
        SystemExit: if the text does not occur exactly once.
    """
    sources = [copy / name for name in names if name.startswith(f"{fault.folder}/")]
    sources = [path for path in sources if path.suffix in (".py", ".c")]
    # A file is listed as often as it has the text.
    holders = [path for path in sources for _ in range(path.read_text("utf-8").count(fault.old))]
    if len(holders) != 1:
        found = ", ".join(str(path.relative_to(copy)) for path in holders) or "nowhere"
        raise SystemExit(
            f"{fault.old!r}: found {len(holders)} times below {fault.folder} ({found}), allowed is "
            "once; make the fault's text in tools/plant_faults.py that of the code"
        )
    return holders[0]


def tests_of(fault: Fault, names: list[str]) -> list[str]:
    """Return the test files of a fault that are among the `names` of all files.

    Raises:
        SystemExit: if none exists.
    """
    ends = tuple(f"/{name}.py" for name in fault.tests.split())
    folder = f"tests/{fault.folder.split('/')[0]}/"
    tests = [name for name in names if name.startswith(folder) and name.endswith(ends)]
    if not tests:
        raise SystemExit(f"{fault.old!r}: no test file is called {fault.tests}; name existing ones")
    return tests


def run_tests(copy: Path, tests: list[str], cpu_s: float = LONGEST_S) -> tuple[int, str]:
    """Run `tests` in the folder `copy`, for at most `cpu_s` of processor time [s].

    Returns:
        The exit code of pytest, and its last line about a failed test, or else its last line.
    """
    limits = (int(cpu_s), int(cpu_s) + 5)
    options = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--assert=plain"]
    try:
        ended = subprocess.run(
            [sys.executable, "-m", "pytest", *options, *tests],
            cwd=copy, capture_output=True, text=True, timeout=LONGEST_S,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, limits),
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return FAILED, f"not done after {LONGEST_S:g} s"
    lines = (ended.stdout + ended.stderr).splitlines() or ["printed nothing"]
    failed = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
    return ended.returncode, (failed or lines)[-1][:160]


class Work:
    """A copy of a checkout in which faults are planted, and the stored results of tests."""

    def __init__(self, tree: Path, copy: Path, out: Path) -> None:
        """Copy the checkout `tree` to `copy`; results are stored in the file `out`."""
        self.names, self.copy, self._out = copy_tree(tree, copy), copy, out
        self._done = json.loads(out.read_text("utf-8")) if out.is_file() else {}

    def result(self, number: int) -> dict[str, Any]:
        """Return whether the tests catch fault `number` (from 1), and their message.

        Raises:
            SystemExit: if the tests fail without the fault.
        """
        fault = FAULTS[number - 1]
        place, tests = place_of(fault, self.names, self.copy), tests_of(fault, self.names)
        original = place.read_text("utf-8")
        code, message = self._run(tests, place)
        if code:
            raise SystemExit(f"{' '.join(tests)}: fail without any fault ({message}); repair them")
        place.write_text(original.replace(fault.old, fault.new), "utf-8")
        try:
            code, message = self._run(tests, place)
        finally:
            place.write_text(original, "utf-8")
        file = str(place.relative_to(self.copy))
        return {"number": number, "file": file, "caught": code != 0, "said": message}

    def _run(self, tests: list[str], place: Path) -> tuple[int, str]:
        """Run tests, and store the result; or return the result that is stored already.

        A stored result counts for the same contents of the tests and of the file `place`.
        """
        sha256 = hashlib.sha256()
        for path in (place, *(self.copy / test for test in tests)):
            sha256.update(path.read_bytes())
        key = f"{' '.join(tests)} {place.relative_to(self.copy)} {sha256.hexdigest()[:16]}"
        if key not in self._done:
            self._done[key] = run_tests(self.copy, tests)
            self._out.parent.mkdir(parents=True, exist_ok=True)
            temporary = self._out.with_suffix(".new")
            temporary.write_text(json.dumps(self._done, indent=1), "utf-8")
            temporary.replace(self._out)
        return self._done[key]


def main() -> int:
    """Plant the faults, print the results, and return the exit code."""
    parser = argparse.ArgumentParser(description="plant faults, and count those that tests catch")
    parser.add_argument("--tree", type=Path, default=ROOT, help="checkout whose code is changed")
    parser.add_argument("--out", type=Path, default=Path("runs/faults.json"), help="results, JSON")
    parser.add_argument("--only", type=int, nargs="+", help="numbers of the faults, from 1")
    parser.add_argument("--list", action="store_true", help="print the faults and their tests")
    args = parser.parse_args()
    numbers = args.only or list(range(1, len(FAULTS) + 1))
    with tempfile.TemporaryDirectory() as folder:
        work = Work(args.tree, Path(folder) / "tree", args.out)
        for number in numbers:
            fault = FAULTS[number - 1]
            place = place_of(fault, work.names, work.copy).relative_to(work.copy)
            tests = tests_of(fault, work.names)
            if args.list:
                print(f"{number} {place}: {fault.old!r} -> {fault.new!r}; {' '.join(tests)}")
        if args.list:
            return 0
        results = []
        for number in numbers:
            row = work.result(number)
            results.append(row)
            verdict = "caught" if row["caught"] else "SURVIVED"
            print(f"{number} {row['file']}: {verdict} ({row['said']})", flush=True)
    caught = sum(row["caught"] for row in results)
    print(f"{caught} of {len(results)} caught")
    return 0 if caught == len(results) else 1


if __name__ == "__main__":
    raise SystemExit(main())
