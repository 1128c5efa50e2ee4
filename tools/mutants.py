"""Mutation testing: change the code at random places, and count the changes that tests detect.

    python tools/mutants.py COUNT [--seed N] [--out FILE.json] [--again]

A mutant is a copy of the code with one change: another operator (+ for -, * for /, < for <=, == for
!=, and for or, & for |, and the reverse), one sign or `not` less, or another number. It survives if
no test fails. The tool does not change messages, annotations and subscripts. Nor does it change
numbers that are a choice: defaults of settings, bounds and usual sizes in the catalogue, and
tolerances below 1e-6. AREAS lists the files and their tests, which run up to the first failure.

The same command continues after an interruption, also with changed code: mutants with a result in
FILE.json come first, then others. With --again those that survived are tested again. The tool
prints the survivors. The exit code is 1 if more than 5 % survive.
"""

from __future__ import annotations

import argparse
import ast
import json
import random
import re
import resource
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from plant_faults import LONGEST_S, ROOT, copy_tree, run_tests

IMPORTERS = (
    "importers/test_frames importers/test_mapping importers/test_foreign importers/test_importers"
)
"""Tests of the importers, as in `AREAS`."""
AREAS = (
    ("suite/train/losses.py", "suite/train/test_losses suite/train/test_config"),
    ("tracks/geometry/field.py", "tracks/geometry/test_geometry"),
    ("tracks/geometry/gates.py", "tracks/families tracks/geometry"),
    ("eval/worlds/trial.py", "eval/worlds/test_trial eval/worlds/test_worlds"),
    ("eval/judging/ages.py", "eval/judging/test_ages"),
    ("eval/judging/guard.py", "eval/judging/test_guard eval/judging/test_actions"),
    ("eval/judging/statistics.py", "eval/judging/test_statistics suite/judging/test_comparing"),
    ("suite/delta/windows.py", "suite/delta/test_windows"),
    ("suite/delta/fit.py", "suite/delta/test_fit"),
    ("eval/effects/*.py", "effects/test_equations effects/test_effects quadrotor/test_rotors "
     "quadrotor/test_stepper"),
    ("eval/importers/frames.py", IMPORTERS),
    ("eval/importers/mapping*.py", IMPORTERS),
    ("eval/importers/formats/*.py", f"{IMPORTERS} importers/test_damaged"),
    ("policies/formats/c/templates/*.c", "policies/formats/c"),
)  # fmt: skip
"""Areas of the code: files, and their tests as paths below tests/ without .py. A path that begins
with no package is below tests/eval/."""
PAIRS = "+ - * / < <= > >= == != and or & |".split()
"""Operators; the first and the second replace each other, the third and the fourth, and so on."""
OTHER = {operator: PAIRS[k ^ 1] for k, operator in enumerate(PAIRS)} | {"**": "*"}
"""Operator -> the operator that replaces it, the other one of its pair (k ^ 1 is the neighbour of
an even or odd k)."""
CHOICE = re.compile(r"\w+: [^#]* = |(.*\W)?(low|high|typical)=[^=]*$")
"""Pattern of the text before a default, a bound or a usual size in its line."""
TOLERANCE = re.compile(r"\d+(\.\d*)?e-([7-9]|[1-9]\d)f?")
"""Pattern of a number below 1e-6."""
C_TOKEN = re.compile(r"(?<= )(\+|-|\*|/|<|<=|>|>=|==|!=|&&)(?= )|(?<![\w.])\d+\.\d*f?\b")
"""Pattern of an operator or a number in C code."""


class Mutant(NamedTuple):
    """One change of a file."""

    file: str
    """Path of the file, relative to the checkout."""
    first: int
    """Index of the first byte that is replaced."""
    last: int
    """Index of the first byte after those that are replaced."""
    new: str
    """Text that replaces them."""
    tests: str
    """Tests of the file, as in `AREAS`."""


def other_number(text: str) -> str:
    """Return a number as text: an integer one larger than that in `text`, or a float 1.25 times."""
    value = ast.literal_eval(text.rstrip("f"))
    return f"({value + 1 if isinstance(value, int) else 1.25 * value or 1.0!r})"


def changes(source: bytes) -> Iterator[tuple[int, int, str]]:
    """Yield (first, last, new) of every possible change of a Python file, as in `Mutant`."""
    # The syntax tree has lines and columns; a change has bytes of the file.
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def span(node: ast.expr) -> tuple[int, int]:
        """Return the first byte of a node, and the first byte after it."""
        assert node.end_lineno and node.end_col_offset is not None
        return (starts[node.lineno - 1] + node.col_offset,
                starts[node.end_lineno - 1] + node.end_col_offset)  # fmt: skip

    def visit(node: ast.AST) -> Iterator[tuple[int, int, str]]:
        """Yield the changes of a node and of the nodes in it."""
        pairs: list[tuple[ast.expr, ast.expr]] = []
        if isinstance(node, ast.BinOp):
            pairs = [(node.left, node.right)]
        elif isinstance(node, ast.Compare):
            pairs = list(zip([node.left, *node.comparators], node.comparators, strict=False))
        elif isinstance(node, ast.BoolOp):
            pairs = list(zip(node.values, node.values[1:], strict=False))
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
            yield span(node)[0], span(node.operand)[0], ""
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
            yield *span(node), other_number(repr(node.value))
        # The operator is in the text between its two operands.
        for left, right in pairs:
            first, last = span(left)[1], span(right)[0]
            for operator in re.finditer(
                rb"\*\*|[<>=!]=|[-+*/<>&|]|\b(and|or)\b", source[first:last]
            ):
                yield first + operator.start(), first + operator.end(), OTHER[operator[0].decode()]
        for name, value in ast.iter_fields(node):
            skipped = name in ("annotation", "returns", "decorator_list", "slice")
            if isinstance(node, ast.Raise | ast.JoinedStr | ast.Assert) or skipped:
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from visit(child)

    yield from visit(ast.parse(source))


def mutants(copy: Path) -> list[list[Mutant]]:
    """Return all mutants of each area in `AREAS`; `copy` is the folder of the code."""
    areas = []
    for pattern, tests in AREAS:
        areas.append([])
        for path in sorted(copy.glob(pattern)):
            source, file = path.read_bytes(), str(path.relative_to(copy))
            if path.suffix == ".py":
                spots = list(changes(source))
            else:
                text = C_TOKEN.finditer(source.decode("ascii"))
                spots = [(m.start(), m.end(), OTHER.get(m[0]) or other_number(m[0].strip("&")))
                         for m in text if m[0] != "&&"]  # fmt: skip
            areas[-1] += [Mutant(file, *spot, tests) for spot in spots]
    return areas


def describe(copy: Path, mutant: Mutant) -> tuple[str, bool]:
    """Return the name of a mutant, and whether a test should detect it.

    The name has the text of the line, not its number, so it stays the same if other lines change.
    A test cannot detect a change of a number that is a choice, such as a default.
    """
    source = (copy / mutant.file).read_bytes()
    lines, row = source.splitlines(), source[: mutant.first].count(b"\n")
    text, equal_before = lines[row].decode().strip(), lines[:row].count(lines[row])
    text_before = source[: mutant.first].splitlines()[-1].decode().lstrip()
    old = source[mutant.first : mutant.last].decode()
    choice = CHOICE.match(text_before) or TOLERANCE.fullmatch(old)
    name = (
        f"{mutant.file}: {old!r} -> {mutant.new!r} at {len(text_before)} in {text!r}"
        + f" {equal_before + 1}" * bool(equal_before)
    )
    return name, not choice


def tests_fail(copy: Path, tests: str, cpu_s: float = LONGEST_S) -> bool:
    """Return whether `tests` fail, or need more than `cpu_s` of processor time [s].

    Raises:
        SystemExit: if the tests did not run.
    """
    names = [part if part.startswith(("suite", "tracks", "policies", "eval")) else f"eval/{part}"
             for part in tests.split()]  # fmt: skip
    paths = [f"tests/{name}" if (copy / "tests" / name).is_dir() else f"tests/{name}.py"
             for name in names]  # fmt: skip
    code, message = run_tests(copy, paths, cpu_s)
    if code > 2:
        raise SystemExit(f"{tests}: pytest ended with {code} ({message})")
    return code != 0  # 1: a test failed; 2: the mutant cannot be imported


def children_s() -> float:
    """Return the processor time of all child processes that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> int:
    """Test mutants, an equal share of each area in random order, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/mutants.json"))
    parser.add_argument("--again", action="store_true", help="test survivors again")
    args = parser.parse_args()
    detected = json.loads(args.out.read_text("utf-8")) if args.out.is_file() else {}
    known = {name: killed or not args.again for name, killed in detected.items() if " -> " in name}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    rng, survivors = random.Random(args.seed), []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        copy_tree(ROOT, copy)
        # The order takes one mutant of each area in turn, so that all have an equal share.
        areas = [rng.sample(area, len(area)) for area in mutants(copy)]
        longest = max(map(len, areas))
        order = [area[k] for k in range(longest) for area in areas if k < len(area)]
        described = [(*describe(copy, mutant), mutant) for mutant in order]
        candidates = [(name, mutant) for name, is_detectable, mutant in described if is_detectable]
        # Mutants with a result come first, so that a change of the code selects no new ones.
        candidates.sort(key=lambda candidate: candidate[0] not in known)
        limit_s: dict[str, float] = {}
        for name, mutant in candidates[: args.count]:
            if not known.get(name):
                # Tests without a mutant must pass; their time gives the limit for the mutants.
                if mutant.tests not in limit_s:
                    processor_s_before = children_s()
                    if tests_fail(copy, mutant.tests):
                        raise SystemExit(f"{mutant.tests}: fail without any mutant; repair them")
                    limit_s[mutant.tests] = 20.0 + 3.0 * (children_s() - processor_s_before)
                path = copy / mutant.file
                source = path.read_bytes()
                changed = source[: mutant.first] + mutant.new.encode() + source[mutant.last :]
                path.write_bytes(changed)
                detected[name] = tests_fail(copy, mutant.tests, limit_s[mutant.tests])
                path.write_bytes(source)
                args.out.write_text(json.dumps(detected, indent=1), "utf-8")
            if not detected[name]:
                survivors.append(name)
                print(name, flush=True)
    count = min(args.count, len(candidates))
    print(f"{len(survivors)} of {count} survive")
    return int(len(survivors) > 0.05 * count)


if __name__ == "__main__":
    raise SystemExit(main())
