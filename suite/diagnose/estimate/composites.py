"""Composites: effects that are tested together as one hypothesis, as a wind and a drag.

A wind does nothing where no drag passes it on, and no drag pushes a vehicle that hovers: where the
vehicle file has none, each alone explains nothing, and both together do. The catalogue's other
names are weighed against the whole, with all its numbers counted; what is named are its parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.estimate.parameters import JOIN, Candidate, ParameterSpace


@dataclass(frozen=True)
class Composite:
    """Effects that are one hypothesis."""

    parts: tuple[str, ...]
    """Names of the effects."""
    about: str
    """For people."""
    carried: str | None = None
    """Which of the parts acts through the others alone; None where each acts on its own."""


COMPOSITES = (
    Composite(
        ("constant_wind", "linear_drag"),
        "a wind and the drag that passes it on",
        carried="constant_wind",
    ),
    Composite(
        ("constant_wind", "quadratic_drag"),
        "a wind and the drag that passes it on",
        carried="constant_wind",
    ),
    Composite(("mass_offset", "com_offset"), "a payload: its mass, and where it sits"),
)
"""What is tried together."""


def composites(among: Sequence[Candidate]) -> list[Candidate]:
    """Return the composites whose parts are all `among` the candidates."""
    found = []
    for composite in COMPOSITES:
        parts = [c for name in composite.parts for c in among if c.name == name]
        if len(parts) == len(composite.parts):
            name = JOIN.join(composite.parts)
            indices = tuple(sorted(i for part in parts for i in part.indices))
            found.append(Candidate(name, indices, name, tuple(parts)))
    return found


def acts_through(one: Candidate) -> bool:
    """Return whether `one`, or a part of it, acts through other effects alone."""
    return any(composite.carried in one.effects for composite in COMPOSITES if composite.carried)


def carried(among: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates that may act through another part of a composite `among` them alone."""
    names = {composite.carried for composite in COMPOSITES}
    return [part for one in among for part in one.parts if part.name in names]


def in_words(sets: Sequence[tuple[str, ...]]) -> list[str]:
    """Return the words on composites in the `sets` of names of a diagnosis, a line each.

    A set has the name first and then what could stand in its place.
    """
    first, others = {one[0] for one in sets}, {name for one in sets for name in one[1:]}
    lines = []
    for composite in COMPOSITES:
        if set(composite.parts) <= first and composite.carried:
            lines.append(
                f"{' and '.join(composite.parts)} belong together: {composite.about}. One without "
                "the other explains nothing here, or less."
            )
        if JOIN.join(composite.parts) in others:
            lines.append(f"{JOIN.join(composite.parts)}: {composite.about}, as one hypothesis.")
    return lines


@dataclass(frozen=True)
class Inactive:
    """Numbers that do nothing as things stand, and where what they act through is there."""

    numbers: tuple[int, ...]
    """Their places in the vector."""
    theta: np.ndarray
    """(P,) where they act: with what they act through at its usual size."""


def inactive_at(
    space: ParameterSpace, theta: np.ndarray, among: Sequence[Candidate], acts: np.ndarray
) -> Inactive | None:
    """Return what acts through parts of composites alone and so does nothing at `theta` (P,).

    None where all of it acts. The first composite of a number determines through what it acts;
    `acts` (P,) holds which numbers do something at `theta`.
    """
    for composite in COMPOSITES:
        whole = next((c for c in among if c.name == JOIN.join(composite.parts)), None)
        if composite.carried is None or whole is None:
            continue
        carried = _part(whole, composite.carried).indices
        if acts[list(carried)].any() or theta[list(carried)].any():
            continue  # it acts, or it is named and what it acts through was taken out
        raised, usual = theta.copy(), usual_size(space)
        through = [i for i in whole.indices if i not in carried]
        raised[through] = theta[through] + usual[through]
        return Inactive(carried, raised)
    return None


def usual_size(space: ParameterSpace) -> np.ndarray:
    """Return the middle (P,) of the usual magnitudes of every number."""
    usual = {(e.name, p.name): p.typical for e in EFFECTS.values() for p in e.parameters}
    return np.array([np.mean(usual[entry.effect, entry.parameter]) for entry in space.entries])


def begin_of(
    space: ParameterSpace,
    theta: np.ndarray,
    candidate: Candidate,
    inactive: Sequence[int],
    change: np.ndarray,
    weight: np.ndarray,
) -> np.ndarray:
    """Return the numbers (P,) from which a composite with `inactive` numbers is fitted.

    The slopes identify a drag times a wind; where they give no drag it takes the smallest
    usual one, and the wind as much more.

    Args:
        space: of the vehicle.
        theta: (P,) where the slopes were taken.
        candidate: the composite.
        inactive: its numbers that act through the others, whose slopes were taken with those at
            their usual size.
        change: (P,) of all numbers by the slopes.
        weight: (P,) information of the flights on each number.
    """
    begin = np.clip(theta + change, space.array("low"), space.array("high"))
    through = np.array([i for i in candidate.indices if i not in inactive])
    usual = usual_size(space)[through]
    least = space.array("start")[through] + 0.3 * usual
    begin[through] = np.maximum(begin[through], least)
    share = (begin[through] - space.array("start")[through]) / usual
    info = weight[through] * usual**2
    mean = float((share * info).sum() / info.sum()) if info.sum() > 0.0 else float(share.mean())
    at = np.array(inactive, dtype=int)
    begin[at] = theta[at] + change[at] / mean
    return np.clip(begin, space.array("low"), space.array("high"))


def _part(whole: Candidate, name: str) -> Candidate:
    return next(part for part in whole.parts if part.name == name)
