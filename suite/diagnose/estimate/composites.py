"""Composites: effects that are tested together as one hypothesis, such as a wind and a drag.

A wind acts only through a drag, and on a vehicle that hovers a drag acts only in a wind. So where
the vehicle file has neither, each alone explains nothing, but both together may. A composite is
compared with single effects; all its parameters count. If it wins, its parts are named one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from suite.diagnose.estimate.parameters import (
    JOIN,
    Candidate,
    ParameterSpace,
    effects_in,
    indices_of,
    parameter_of,
)


class Composite(NamedTuple):
    """Effects that are tested as one hypothesis: their names, and a description for people."""

    parts: tuple[str, ...]
    """Names of the effects."""
    about: str
    """Description for people."""
    carried: str | None = None
    """Name of the effect that only acts through (is carried by) the others; None without one."""


WIND, PASSED_ON = "constant_wind", "a wind and the drag that passes it on"
COMPOSITES = (
    Composite((WIND, "linear_drag"), PASSED_ON, carried=WIND),
    Composite((WIND, "quadratic_drag"), PASSED_ON, carried=WIND),
    Composite(("mass_offset", "com_offset"), "a payload: its mass, and where it sits"),
)
LEAST_USUAL = 0.3
"""Smallest drag with which a fit of a composite begins, as a share of a drag's usual size."""


def composites(among: Sequence[Candidate]) -> list[Candidate]:
    """Return a candidate for each composite whose parts are all `among` the candidates."""
    candidates = []
    for composite in COMPOSITES:
        parts = [c for name in composite.parts for c in among if c.name == name]
        if len(parts) == len(composite.parts):
            name = JOIN.join(composite.parts)
            candidates.append(Candidate(name, tuple(indices_of(parts)), name, tuple(parts)))
    return candidates


def acts_through(candidate: Candidate) -> bool:
    """Return whether `candidate`, or a part of it, only acts through other effects."""
    names = effects_in(candidate.name)
    return any(one.carried in names for one in COMPOSITES if one.carried)


def carried(among: Sequence[Candidate]) -> list[Candidate]:
    """Return those parts of composites in `among` that only act through other parts."""
    names = {composite.carried for composite in COMPOSITES}
    return [part for one in among for part in one.parts if part.name in names]


def in_words(sets: Sequence[tuple[str, ...]]) -> list[str]:
    """Return lines on composites; each of `sets` is a named effect and then its alternatives."""
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


def inactive_at(
    space: ParameterSpace, theta: np.ndarray, among: Sequence[Candidate], acts: np.ndarray
) -> tuple[tuple[int, ...], np.ndarray] | None:
    """Return the parameters that change nothing at `theta` (P,), such as a wind without a drag.

    Returned are their places, and all parameters (P,) with usual sizes of the effects through which
    they act; None where there are none. The first composite that contains them counts. `acts` (P,)
    bool marks the parameters that change the model at `theta`.
    """
    for composite in among:
        for part in carried([composite]):
            inactive = list(part.indices)
            if acts[inactive].any() or theta[inactive].any():
                continue  # it acts, or was named and the effect through which it acts was dropped
            carriers = [i for i in composite.indices if i not in inactive]
            raised = theta.copy()
            raised[carriers] += usual_size(space)[carriers]
            return part.indices, raised
    return None


def usual_size(space: ParameterSpace) -> np.ndarray:
    """Return the usual magnitude (P,) of every parameter: the middle of its usual range."""
    return np.array([np.mean(parameter_of(entry).typical) for entry in space.entries])


def begin_of(
    space: ParameterSpace,
    theta: np.ndarray,
    candidate: Candidate,
    inactive: Sequence[int],
    change: np.ndarray,
    information: np.ndarray,
) -> np.ndarray:
    """Return the parameters (P,) with which the fit of a composite begins.

    A linear fit at `theta` (P,) identifies a drag, and the product of drag and wind. The wind is
    that product over the drag, relative to the drag's usual size, of which at least `LEAST_USUAL`
    is used. `inactive` are the places of the wind; its slopes were computed with the usual drag.
    `change` (P,) is the change of all parameters by the linear fit, and `information` (P,) that of
    the flights on each.
    """
    begin = np.clip(theta + change, space.array("low"), space.array("high"))
    carrier_indices = np.array([i for i in candidate.indices if i not in inactive])
    usual = usual_size(space)[carrier_indices]
    least = space.array("start")[carrier_indices] + LEAST_USUAL * usual
    begin[carrier_indices] = np.maximum(begin[carrier_indices], least)
    # Mean of the drag's components, as shares of their usual size, by their information.
    share = (begin[carrier_indices] - space.array("start")[carrier_indices]) / usual
    weight = information[carrier_indices] * usual**2
    total = weight.sum()
    mean = float((share * weight).sum() / total) if total > 0.0 else float(share.mean())
    carried_indices = np.array(inactive, dtype=int)
    begin[carried_indices] = theta[carried_indices] + change[carried_indices] / mean
    return np.clip(begin, space.array("low"), space.array("high"))
