"""Draw the blind cases of a set from its seed: which effects are hidden, at which strength.

A blind case is a set of flights with hidden effects, which the diagnosis must name. A null is a
case without a hidden effect. The order of the cases is random, so that it reveals nothing about the
hidden effects.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from eval.effects import EFFECTS, nameable_effects
from eval.worlds.rotorpy_vehicle import ROTORPY_EFFECTS
from suite.blind.oracle.strength import vehicle_names
from suite.blind.outside import KINDS
from suite.diagnose.plan import SEPARATIONS

MULTIPLES = (2.0, 6.0)
"""Strengths of single effects, as multiples of the just detectable strength."""
FULL_COUNTS = {"null": 100, "outside": 40, "pair": 20, "blurred": 15, "separated": 15}
"""Kind -> number of cases in a full MuJoCo set, for all kinds except single effects."""
SETS = {"tuning": 1_000_000, "published": 2_000_000}
"""Name of each set -> its seed. The published set is run once, after all development."""
ROTORPY_COUNTS = {"null": 24, "pair": 16}
"""Kind -> number of cases in the RotorPy set, for all kinds except single effects."""
CONTINUOUS_COUNTS = {"null": 24, "single": 22, "pair": 10, "outside": 4}
"""Kind -> number of cases in the continuous-time set."""
EXCLUDED = "hysteresis"
"""Physics outside the catalogue that the continuous-time set does not have: at its usual strength,
most flights close to the ground crash."""
MUJOCO, ROTORPY, CONTINUOUS = "mujoco", "rotorpy", "continuous"
"""Names of the simulators of cases."""


@dataclass(frozen=True)
class Case:
    """The description of a case, before strengths and flights are computed."""

    kind: str
    """`single` (one effect), `null` (no effect), `pair` (two effects), `outside` (physics that is
    not in the catalogue), `blurred` (one effect, and flights that do not separate it from another
    one) or `separated` (the same with additional flights, which separate the two)."""
    hidden: tuple[str, ...]
    """The hidden effects, or one kind of physics outside the catalogue."""
    multiple: float
    """Strength of the hidden effects, as a multiple of the just detectable strength."""
    vehicle: str
    """Name of the vehicle file that the diagnosis gets."""
    sensors: str
    """Name of the logged channels and their noise, a key of `SENSORS`."""
    seed: tuple[int, int]
    """Seeds of all other draws: that of the set, and a number that no other case of the set has,
    except for a blurred case and its separated twin."""
    separation: int = -1
    """Index in `SEPARATIONS` (pairs of effects, and flights that separate them) for a blurred or
    separated case; -1 for the other kinds."""
    simulator: str = MUJOCO
    """Simulator of the flights."""


def full_count() -> int:
    """Return the number of cases of a full set."""
    return len(nameable_effects()) * len(MULTIPLES) + sum(FULL_COUNTS.values())


def draw_cases(seed: int, count: int | None = None) -> dict[str, Case]:
    """Return the cases of a set by name (`case_001`, ...).

    Args:
        seed: seed of the set.
        count: approximate number of cases, with the same share of every kind and at least one of
            each; None: all.

    Raises:
        ValueError: for a count below 1.
    """
    share = _share_of(count, full_count())
    rng = np.random.default_rng([seed, 0])
    cases = _draw_singles(rng, seed, share)
    for kind, number in FULL_COUNTS.items():
        for index in range(max(round(share * number), 1)):
            case_seed = (seed, 20_000 + 1_000 * list(FULL_COUNTS).index(kind) + index)
            cases.append(_draw_case(rng, kind, index, case_seed))
    order = rng.permutation(len(cases))
    digits = max(len(str(len(cases))), 3)
    return {f"case_{i + 1:0{digits}d}": cases[number] for i, number in enumerate(order)}


def draw_rotorpy_cases(seed: int, count: int | None = None) -> dict[str, Case]:
    """Return the RotorPy set: single effects at both multiples, pairs of effects, and nulls.

    The effects are those that RotorPy can simulate.

    Arguments and errors are those of `draw_cases`.
    """
    rng = np.random.default_rng([seed, 1])
    drawn: list[tuple[str, tuple[str, ...], float]] = [
        ("single", (name,), m) for m in MULTIPLES for name in ROTORPY_EFFECTS
    ]
    for _ in range(ROTORPY_COUNTS["pair"]):
        first, second = (str(name) for name in rng.choice(ROTORPY_EFFECTS, 2, replace=False))
        drawn.append(("pair", (first, second), MULTIPLES[1]))
    drawn += [("null", (), 0.0)] * ROTORPY_COUNTS["null"]
    # Keep the first ones of each kind in a random order, as many as its share.
    share, kind_counts = _share_of(count, len(drawn)), Counter(kind for kind, *_ in drawn)
    remaining = {kind: max(round(share * number), 1) for kind, number in kind_counts.items()}
    cases = {}
    for index in rng.permutation(len(drawn)):
        kind, hidden, multiple = drawn[index]
        if not remaining[kind]:
            continue
        remaining[kind] -= 1
        sensors = str(rng.choice(["capture", "estimator", "full"]))
        case_seed = (seed, 50_000 + int(index))
        cases[f"case_{len(cases) + 1:03d}"] = Case(
            kind, hidden, multiple, "bare", sensors, case_seed, simulator=ROTORPY
        )
    return cases


def draw_continuous_cases(seed: int, count: int | None = None) -> dict[str, Case]:
    """Return the continuous-time set.

    It has each single effect once at most, half of them at each of `MULTIPLES`. Arguments and
    errors are those of `draw_cases`.
    """
    share = _share_of(count, sum(CONTINUOUS_COUNTS.values()))
    rng = np.random.default_rng([seed, 2])
    singles = rng.permutation(nameable_effects())
    others = rng.permutation([kind for kind in KINDS if kind != EXCLUDED])
    cases = []
    for kind, number in CONTINUOUS_COUNTS.items():
        for index in range(max(round(share * number), 1)):
            case_seed = (seed, 70_000 + 1_000 * list(CONTINUOUS_COUNTS).index(kind) + index)
            if kind == "single":
                name, multiple = str(singles[index]), MULTIPLES[index % len(MULTIPLES)]
                case = Case(kind, (name,), multiple, *_draw_equipment(rng, (name,)), case_seed)
            else:
                case = _draw_case(rng, kind, index, case_seed)
            if kind == "outside":
                case = replace(case, hidden=(str(others[index]),))
            cases.append(replace(case, simulator=CONTINUOUS))
    order = rng.permutation(len(cases))
    return {f"case_{i + 1:03d}": cases[number] for i, number in enumerate(order)}


DRAWERS: dict[str, Callable[[int, int | None], dict[str, Case]]] = {
    MUJOCO: draw_cases,
    ROTORPY: draw_rotorpy_cases,
    CONTINUOUS: draw_continuous_cases,
}
"""Simulator -> function (seed, approximate number of cases) that draws its set."""


def _share_of(count: int | None, full: int) -> float:
    """Return the share of the cases of a `full` set that `count` cases are, at most 1.

    Raises:
        ValueError: for a count below 1.
    """
    if count is not None and count < 1:
        raise ValueError(f"count = {count}: must be at least 1")
    return 1.0 if count is None else min(count / full, 1.0)


def _draw_singles(rng: np.random.Generator, seed: int, share: float) -> list[Case]:
    """Return a `share` of the cases with one effect, each at both multiples."""
    all_singles = [((name,), multiple) for multiple in MULTIPLES for name in nameable_effects()]
    count = max(round(share * len(all_singles)), 1)
    cases = []
    for index in sorted(rng.permutation(len(all_singles))[:count]):
        names, multiple = all_singles[index]
        case_seed = (seed, 10_000 + index)
        cases.append(Case("single", names, multiple, *_draw_equipment(rng, names), case_seed))
    return cases


def _draw_case(rng: np.random.Generator, kind: str, index: int, case_seed: tuple[int, int]) -> Case:
    """Return case number `index` of a `kind` other than `single`, on MuJoCo."""
    seed = case_seed[0]
    if kind == "outside":
        name, equipment = list(KINDS)[index % len(KINDS)], _draw_equipment(rng, ())
        return Case(kind, (name,), float(rng.choice([3.0, 6.0])), *equipment, case_seed)
    if kind == "pair":
        names = nameable_effects()
        pool = [name for name in names if not (EFFECTS[name].random or EFFECTS[name].slow)]
        pair = tuple(pool[i] for i in rng.choice(len(pool), 2, replace=False))
        return Case(kind, pair, MULTIPLES[1], *_draw_equipment(rng, pair), case_seed)
    if kind in ("blurred", "separated"):
        # A generator by index, so that both kinds have the same pairs with the same truth.
        pair_rng = np.random.default_rng([seed, 3, index])
        entry = index % len(SEPARATIONS)
        pair = SEPARATIONS[entry].pair
        name = pair[int(pair_rng.integers(2))]
        measured = {"motor", "voltage"} & set(SEPARATIONS[entry].measure)
        sensors = "full" if kind == "separated" and measured else "capture"
        vehicle, _ = _draw_equipment(pair_rng, pair)
        pair_seed = (seed, 30_000 + index)
        return Case(kind, (name,), MULTIPLES[0], vehicle, sensors, pair_seed, entry)
    return Case(kind, (), 0.0, *_draw_equipment(rng, ()), case_seed)


def _draw_equipment(rng: np.random.Generator, names: tuple[str, ...]) -> tuple[str, str]:
    """Return the vehicle and the sensors for a case in which the effects `names` can act."""
    vehicle = str(rng.choice(vehicle_names()))
    sensors = str(rng.choice(["capture", "estimator", "full"]))
    if any(EFFECTS[name].wind for name in names):
        vehicle = "dragged"  # wind has no effect on a vehicle without drag
    if sensors == "capture" and any("acc_b" in EFFECTS[name].needs for name in names):
        sensors = "estimator"
    return vehicle, sensors
