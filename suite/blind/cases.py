"""The cases of a set, drawn from its seed, in an order without relation to the hidden effects."""

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
FULL = {"null": 100, "outside": 40, "pair": 20, "blurred": 15, "separated": 15}
"""Other cases of a full set than single effects, by kind."""
SETS = {"tuning": 1_000_000, "published": 2_000_000}
"""Seeds of the two sets; the published one is run once."""
ROTORPY_FULL = {"null": 24, "pair": 16}
"""Other cases of the RotorPy set than single effects, by kind."""
CONTINUOUS_FULL = {"null": 24, "single": 22, "pair": 10, "outside": 4}
"""Cases of the continuous-time set, by kind."""
TOO_ROUGH = "hysteresis"
"""Physics that this set leaves out: at its usual strength most flights close to the ground end in a
crash."""
MUJOCO, ROTORPY, CONTINUOUS = "mujoco", "rotorpy", "continuous"
"""Simulators of cases."""


@dataclass(frozen=True)
class Case:
    """The description of a case, before strengths and flights are computed."""

    kind: str
    """single, null, outside, pair, blurred or separated."""
    hidden: tuple[str, ...]
    """The hidden effects, or one kind of physics outside the catalogue."""
    multiple: float
    """Strength, as a multiple of the detectable one."""
    vehicle: str
    """The vehicle file for the diagnosis."""
    sensors: str
    """Name of the logged channels and their noise."""
    seed: tuple[int, int]
    """Seeds of all other draws: the set's, and the case's number within its kind."""
    separation: int = -1
    """Index in `SEPARATIONS`, if there is one."""
    simulator: str = MUJOCO
    """Its simulator."""


def full_count() -> int:
    """Return the number of cases of a full set."""
    return len(nameable_effects()) * len(MULTIPLES) + sum(FULL.values())


def draw_cases(seed: int, count: int | None = None) -> dict[str, Case]:
    """Return the cases of a set by name (`case_001`, ...).

    Args:
        seed: of the set.
        count: approximate number, with the same share of every kind, at least one each. None: all.

    Raises:
        ValueError: for a count below 1.
    """
    share = _share_of(count, full_count())
    rng = np.random.default_rng([seed, 0])
    cases = _singles(rng, seed, share)
    for kind, number in FULL.items():
        for index in range(max(round(share * number), 1)):
            own = (seed, 20_000 + 1_000 * list(FULL).index(kind) + index)
            cases.append(_drawn(rng, kind, index, own))
    order = rng.permutation(len(cases))
    digits = max(len(str(len(cases))), 3)
    return {f"case_{i + 1:0{digits}d}": cases[at] for i, at in enumerate(order)}


def draw_rotorpy_cases(seed: int, count: int | None = None) -> dict[str, Case]:
    """Return the RotorPy set: its effects at both multiples, pairs of them, and nulls.

    Arguments and errors are those of `draw_cases`.
    """
    rng = np.random.default_rng([seed, 1])
    drawn: list[tuple[str, tuple[str, ...], float]] = [
        ("single", (name,), m) for m in MULTIPLES for name in ROTORPY_EFFECTS
    ]
    for _ in range(ROTORPY_FULL["pair"]):
        first, second = (str(name) for name in rng.choice(ROTORPY_EFFECTS, 2, replace=False))
        drawn.append(("pair", (first, second), MULTIPLES[1]))
    drawn += [("null", (), 0.0)] * ROTORPY_FULL["null"]
    share, of_kind = _share_of(count, len(drawn)), Counter(kind for kind, *_ in drawn)
    left = {kind: max(round(share * number), 1) for kind, number in of_kind.items()}
    cases = {}
    for index in rng.permutation(len(drawn)):
        kind, hidden, multiple = drawn[index]
        if not left[kind]:
            continue
        left[kind] -= 1
        sensors = str(rng.choice(["capture", "estimator", "full"]))
        number = (seed, 50_000 + int(index))
        cases[f"case_{len(cases) + 1:03d}"] = Case(
            kind, hidden, multiple, "bare", sensors, number, simulator=ROTORPY
        )
    return cases


def draw_continuous_cases(seed: int, count: int | None = None) -> dict[str, Case]:
    """Return the continuous-time set, with each single effect once.

    Half of them are at each multiple. Arguments and errors are those of `draw_cases`.
    """
    share = _share_of(count, sum(CONTINUOUS_FULL.values()))
    rng = np.random.default_rng([seed, 2])
    singles = rng.permutation(nameable_effects())
    others = rng.permutation([kind for kind in KINDS if kind != TOO_ROUGH])
    cases = []
    for kind, number in CONTINUOUS_FULL.items():
        for index in range(max(round(share * number), 1)):
            own = (seed, 70_000 + 1_000 * list(CONTINUOUS_FULL).index(kind) + index)
            if kind == "single":
                name, multiple = str(singles[index]), MULTIPLES[index % len(MULTIPLES)]
                case = Case(kind, (name,), multiple, *_equipment(rng, (name,)), own)
            else:
                case = _drawn(rng, kind, index, own)
            if kind == "outside":
                case = replace(case, hidden=(str(others[index]),))
            cases.append(replace(case, simulator=CONTINUOUS))
    return {f"case_{i + 1:03d}": cases[at] for i, at in enumerate(rng.permutation(len(cases)))}


DRAWERS: dict[str, Callable[[int, int | None], dict[str, Case]]] = {
    MUJOCO: draw_cases,
    ROTORPY: draw_rotorpy_cases,
    CONTINUOUS: draw_continuous_cases,
}
"""Simulator -> function that draws its set from seed and approximate number of cases."""


def _share_of(count: int | None, full: int) -> float:
    if count is not None and count < 1:
        raise ValueError(f"count = {count}: must be at least 1")
    return 1.0 if count is None else min(count / full, 1.0)


def _singles(rng: np.random.Generator, seed: int, share: float) -> list[Case]:
    wanted = [((name,), multiple) for multiple in MULTIPLES for name in nameable_effects()]
    keep = max(round(share * len(wanted)), 1)
    found = []
    for index in sorted(rng.permutation(len(wanted))[:keep]):
        names, multiple = wanted[index]
        own = (seed, 10_000 + index)
        found.append(Case("single", names, multiple, *_equipment(rng, names), own))
    return found


def _drawn(rng: np.random.Generator, kind: str, index: int, number: tuple[int, int]) -> Case:
    seed = number[0]
    if kind == "outside":
        name, equipment = list(KINDS)[index % len(KINDS)], _equipment(rng, ())
        return Case(kind, (name,), float(rng.choice([3.0, 6.0])), *equipment, number)
    if kind == "pair":
        names = nameable_effects()
        pool = [name for name in names if not (EFFECTS[name].random or EFFECTS[name].slow)]
        pair = tuple(pool[i] for i in rng.choice(len(pool), 2, replace=False))
        return Case(kind, pair, MULTIPLES[1], *_equipment(rng, pair), number)
    if kind in ("blurred", "separated"):
        # Both kinds have the same pairs with the same truth: a random stream by index.
        own = np.random.default_rng([seed, 3, index])
        entry = index % len(SEPARATIONS)
        pair = SEPARATIONS[entry].pair
        name = pair[int(own.integers(2))]
        measured = {"motor", "voltage"} & set(SEPARATIONS[entry].measure)
        sensors = "full" if kind == "separated" and measured else "capture"
        at = _equipment(own, pair)[0], sensors, (seed, 30_000 + index)
        return Case(kind, (name,), MULTIPLES[0], *at, entry)
    return Case(kind, (), 0.0, *_equipment(rng, ()), number)


def _equipment(rng: np.random.Generator, names: tuple[str, ...]) -> tuple[str, str]:
    vehicle = str(rng.choice(vehicle_names()))
    sensors = str(rng.choice(["capture", "estimator", "full"]))
    if any(EFFECTS[name].wind for name in names):
        vehicle = "dragged"  # without drag no wind is felt
    if sensors == "capture" and any("acc_b" in EFFECTS[name].needs for name in names):
        sensors = "estimator"
    return vehicle, sensors
