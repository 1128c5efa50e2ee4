"""Composites: effects that are tested together as one hypothesis, such as a wind and a drag.

Without a drag a wind has no effect, and without a wind a drag has none on a vehicle that hovers:
where the vehicle file has neither, each alone explains nothing, but both together may. A composite
is compared with single effects at the number of all its parameters; its parts are named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.estimate.parameters import JOIN, Candidate, ParameterSpace


@dataclass(frozen=True)
class Composite:
    """Effects that are tested as one hypothesis."""

    parts: tuple[str, ...]
    """Names of the effects."""
    about: str
    """Description for people."""
    carried: str | None = None
    """The part that only acts through the others; None where each acts on its own."""


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
"""All composites."""
LEAST_USUAL = 0.3
"""A fit of a composite begins with a drag of at least this share of its usual size."""


def composites(among: Sequence[Candidate]) -> list[Candidate]:
    """Return the composites whose parts are all `among` the candidates."""
    candidates = []
    for composite in COMPOSITES:
        parts = [c for name in composite.parts for c in among if c.name == name]
        if len(parts) == len(composite.parts):
            name = JOIN.join(composite.parts)
            indices = tuple(sorted(i for part in parts for i in part.indices))
            candidates.append(Candidate(name, indices, name, tuple(parts)))
    return candidates


def acts_through(candidate: Candidate) -> bool:
    """Return whether `candidate`, or a part of it, only acts through other effects."""
    return any(one.carried in candidate.effects for one in COMPOSITES if one.carried)


def carried(among: Sequence[Candidate]) -> list[Candidate]:
    """Return the parts of composites `among` the candidates that only act through other parts."""
    names = {composite.carried for composite in COMPOSITES}
    return [part for one in among for part in one.parts if part.name in names]


def in_words(sets: Sequence[tuple[str, ...]]) -> list[str]:
    """Return lines for people on the composites in a diagnosis.

    Each of `sets` has the name of an effect, and then its alternatives.
    """
    names, alternatives = {one[0] for one in sets}, {name for one in sets for name in one[1:]}
    lines = []
    for composite in COMPOSITES:
        if set(composite.parts) <= names and composite.carried:
            lines.append(
                f"{' and '.join(composite.parts)} belong together: {composite.about}. One without "
                "the other explains nothing here, or less."
            )
        if JOIN.join(composite.parts) in alternatives:
            lines.append(f"{JOIN.join(composite.parts)}: {composite.about}, as one hypothesis.")
    return lines


@dataclass(frozen=True)
class Inactive:
    """Parameters without an effect at the present estimate, and values at which they have one."""

    indices: tuple[int, ...]
    """Their places in the vector."""
    theta: np.ndarray
    """(P,) all parameters, with the effects through which these act at their usual size."""


def inactive_at(
    space: ParameterSpace, theta: np.ndarray, among: Sequence[Candidate], acts: np.ndarray
) -> Inactive | None:
    """Return the parameters that only act through others and so have no effect at `theta` (P,).

    None where all of them have one. If several composites contain them, the first one counts.

    Args:
        space: of the vehicle.
        theta: (P,) all parameters.
        among: the candidates.
        acts: (P,) bool: which parameters have an effect at `theta`.
    """
    for composite in COMPOSITES:
        whole = next((c for c in among if c.name == JOIN.join(composite.parts)), None)
        if composite.carried is None or whole is None:
            continue
        own = next(part for part in whole.parts if part.name == composite.carried).indices
        if acts[list(own)].any() or theta[list(own)].any():
            continue  # it acts; or it is named, and the effect through which it acts was dropped
        raised, usual = theta.copy(), usual_size(space)
        through = [i for i in whole.indices if i not in own]
        raised[through] = theta[through] + usual[through]
        return Inactive(own, raised)
    return None


def usual_size(space: ParameterSpace) -> np.ndarray:
    """Return the usual magnitude (P,) of every parameter, the middle of its usual range."""
    usual = {(e.name, p.name): p.typical for e in EFFECTS.values() for p in e.parameters}
    return np.array([np.mean(usual[entry.effect, entry.parameter]) for entry in space.entries])


def begin_of(
    space: ParameterSpace,
    theta: np.ndarray,
    candidate: Candidate,
    inactive: Sequence[int],
    change: np.ndarray,
    information: np.ndarray,
) -> np.ndarray:
    """Return the parameters (P,) from which a composite with `inactive` parameters is fitted.

    The linear fit only identifies the product of a drag and a wind. If its drag is too small, the
    fit begins with the least usual drag, and with as much more wind.

    Args:
        space: of the vehicle.
        theta: (P,) all parameters at the linear fit.
        candidate: the composite.
        inactive: its parameters that act through the others, whose slopes were computed with those
            at their usual size.
        change: (P,) of all parameters by the linear fit.
        information: (P,) of the flights on each parameter.
    """
    begin = np.clip(theta + change, space.array("low"), space.array("high"))
    through = np.array([i for i in candidate.indices if i not in inactive])
    usual = usual_size(space)[through]
    least = space.array("start")[through] + LEAST_USUAL * usual
    begin[through] = np.maximum(begin[through], least)
    share = (begin[through] - space.array("start")[through]) / usual
    weight = information[through] * usual**2
    total = weight.sum()
    mean = float((share * weight).sum() / total) if total > 0.0 else float(share.mean())
    own = np.array(inactive, dtype=int)
    begin[own] = theta[own] + change[own] / mean
    return np.clip(begin, space.array("low"), space.array("high"))
