"""Draw the blind cases of a set from its seed: which effects are hidden, at which strength.

The order of the cases is random, so that it reveals nothing about the hidden effects.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from eval.effects import EFFECTS, nameable_effects
from eval.flights.simulate import SENSORS
from eval.worlds.rotorpy_vehicle import ROTORPY_EFFECTS
from suite.blind.continuous.quadrotor import SUPPORTED
from suite.blind.oracle import vehicle_names
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


def draw_cases(seed: int, count: int | None = None) -> dict[str, Case]:
    """Return the cases of a set by name (`case_001`, ...).

    The `count` of cases is approximate, with the same share of every kind and at least one of each;
    None: all.

    Raises:
        ValueError: for a count below 1.
    """
    singles = [(name, multiple) for multiple in MULTIPLES for name in nameable_effects()]
    counts = _counts(count, {"single": len(singles), **FULL_COUNTS})
    rng = np.random.default_rng([seed, 0])
    cases = []
    for index in sorted(rng.permutation(len(singles))[: counts["single"]]):
        name, multiple = singles[index]
        equipment = _draw_equipment(rng, (name,))
        cases.append(Case("single", (name,), multiple, *equipment, (seed, 10_000 + index)))
    for number, kind in enumerate(FULL_COUNTS):
        for index in range(counts[kind]):
            case_seed = (seed, 20_000 + 1_000 * number + index)
            cases.append(_draw_case(rng, kind, index, case_seed, nameable_effects()))
    return _by_name([cases[index] for index in rng.permutation(len(cases))])


def draw_rotorpy_cases(seed: int, count: int | None = None) -> dict[str, Case]:
    """Return the RotorPy set: single effects at both multiples, pairs of effects, and nulls.

    The effects are those that RotorPy can simulate and a diagnosis may name. Arguments and errors
    are those of `draw_cases`.
    """
    rng = np.random.default_rng([seed, 1])
    effects = [name for name in ROTORPY_EFFECTS if name in nameable_effects()]
    drawn: list[tuple[str, tuple[str, ...], float]] = [
        ("single", (name,), m) for m in MULTIPLES for name in effects
    ]
    for _ in range(ROTORPY_COUNTS["pair"]):
        first, second = (str(name) for name in rng.choice(effects, 2, replace=False))
        drawn.append(("pair", (first, second), MULTIPLES[1]))
    drawn += [("null", (), 0.0)] * ROTORPY_COUNTS["null"]
    # Keep the first ones of each kind in a random order, as many as its share.
    remaining = _counts(count, Counter(kind for kind, *_ in drawn))
    cases = []
    for index in rng.permutation(len(drawn)):
        kind, hidden, multiple = drawn[index]
        if remaining[kind]:
            remaining[kind] -= 1
            sensors, case_seed = str(rng.choice(list(SENSORS))), (seed, 50_000 + int(index))
            cases.append(Case(kind, hidden, multiple, "bare", sensors, case_seed))
    return _by_name([replace(case, simulator=ROTORPY) for case in cases])


def draw_continuous_cases(seed: int, count: int | None = None) -> dict[str, Case]:
    """Return the continuous-time set.

    It has each single effect once at most, half of them at each of `MULTIPLES`. The effects are
    those that the engine has equations for and a diagnosis may name. Arguments and errors are those
    of `draw_cases`.
    """
    counts = _counts(count, CONTINUOUS_COUNTS)
    rng = np.random.default_rng([seed, 2])
    effects = [name for name in nameable_effects() if name in SUPPORTED]
    singles = rng.permutation(effects)
    others = rng.permutation([kind for kind in KINDS if kind != EXCLUDED])
    cases = []
    for number, kind in enumerate(CONTINUOUS_COUNTS):
        for index in range(counts[kind]):
            case_seed = (seed, 70_000 + 1_000 * number + index)
            if kind == "single":
                multiple = MULTIPLES[index % len(MULTIPLES)]
                hidden = (str(singles[index]),)
                case = Case(kind, hidden, multiple, *_draw_equipment(rng, hidden), case_seed)
            else:
                case = _draw_case(rng, kind, index, case_seed, effects)
            if kind == "outside":
                case = replace(case, hidden=(str(others[index]),))
            cases.append(replace(case, simulator=CONTINUOUS))
    return _by_name([cases[index] for index in rng.permutation(len(cases))])


DRAWERS: dict[str, Callable[[int, int | None], dict[str, Case]]] = {
    MUJOCO: draw_cases,
    ROTORPY: draw_rotorpy_cases,
    CONTINUOUS: draw_continuous_cases,
}
"""Simulator -> function (seed, approximate number of cases) that draws its set."""


def _counts(count: int | None, full: Mapping[str, int]) -> dict[str, int]:
    """Return kind -> number of cases, for about `count` cases of a set with the numbers `full`."""
    if count is not None and count < 1:
        raise ValueError(f"count = {count}: must be at least 1")
    share = 1.0 if count is None else min(count / sum(full.values()), 1.0)
    return {kind: max(round(share * number), 1) for kind, number in full.items()}


def _by_name(cases: Sequence[Case]) -> dict[str, Case]:
    """Return name (`case_001`, ...) -> case, in the given order."""
    return {f"case_{number:03d}": case for number, case in enumerate(cases, 1)}


def _draw_case(
    rng: np.random.Generator,
    kind: str,
    index: int,
    case_seed: tuple[int, int],
    effects: Sequence[str],
) -> Case:
    """Return case number `index` of a `kind` other than `single`, on MuJoCo.

    A pair is one of `effects`.
    """
    seed = case_seed[0]
    if kind == "outside":
        name, equipment = list(KINDS)[index % len(KINDS)], _draw_equipment(rng, ())
        return Case(kind, (name,), float(rng.choice([3.0, 6.0])), *equipment, case_seed)
    if kind == "pair":
        pool = [name for name in effects if not (EFFECTS[name].random or EFFECTS[name].slow)]
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
    sensors = str(rng.choice(list(SENSORS)))
    if any(EFFECTS[name].wind for name in names):
        vehicle = "dragged"  # wind has no effect on a vehicle without drag
    if sensors == "capture" and any("acc_b" in EFFECTS[name].needs for name in names):
        sensors = "estimator"
    return vehicle, sensors
