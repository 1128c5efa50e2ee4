"""What is said of a gap: none, named, named in part, or unknown."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from suite.diagnose.data.windows import STATE_GROUPS
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.gap import Gap
from suite.diagnose.verdict.residual_structure import ResidualStructure


class Verdict(NamedTuple):
    """A verdict and its reasons."""

    label: str
    """no_gap, named, partly or unknown."""
    share_left: float = 0.0
    """What is left of the gap on held-out flights, see `share_left`: 1 where nothing is
    named, 0 where there is none."""
    where: str | None = None
    """What the residual goes with, in words."""


def verdict_on(
    named: bool,
    slow_errors: tuple[np.ndarray, np.ndarray],
    residual: ResidualStructure,
    gaps: tuple[Gap, Gap],
    rotor_input: bool,
    limits: Thresholds = THRESHOLDS,
) -> Verdict:
    """Return the verdict on what was found and on the structure in what it leaves over.

    Args:
        named: whether something was named.
        slow_errors: as `RolloutEvidence.slow_errors` has them.
        residual: the structure.
        gaps: those before and after it was found.
        rotor_input: whether measured rotor speeds drive.
        limits: from where on structure is none of noise.
    """
    slow, expected = slow_errors
    shape = residual.shapes[0] if residual.shapes else None
    if shape is not None and shape.p_value > limits.shape_p_value:
        shape = None
    coloured = [
        axis
        for axis, p_value in residual.coloured.items()
        if p_value <= limits.colour_p_value and not rotor_input
    ]
    loud = limits.structure_rotor_input if rotor_input else limits.structure
    if not (shape or coloured or slow.sum() / expected.sum() > loud):
        return Verdict("named", share_left(*gaps)) if named else Verdict("no_gap")
    share = share_left(*gaps) if named else 1.0
    where = [shape.label] if shape else []
    if coloured:
        where.append("a changing " + ", ".join(coloured))
    partly = named and share <= limits.unexplained_share
    where = "; ".join(where) or _loudest(slow.sum(axis=0), expected.sum(axis=0))
    return Verdict("partly" if partly else "unknown", share, where)


def with_swing(verdict: Verdict, words: str, named: bool) -> Verdict:
    """Return `verdict` where a force swings, which nothing that is fitted does.

    `words` say how; `named` whether something was named besides.
    """
    where = f"{words}; {verdict.where}" if verdict.where else words
    if verdict.where is None:
        return Verdict(
            "partly" if named else "unknown", verdict.share_left if named else 1.0, where
        )
    return verdict._replace(where=where)


def share_left(before: Gap, after: Gap) -> float:
    """Return how much of the gap above the noise floor is left, 0 to 1."""
    left = max(after.rms - 1.0, 0.0)
    return left / max(before.rms - 1.0, left, 1e-9)


def _loudest(slow: np.ndarray, expected: np.ndarray) -> str:
    """Return the channels with most energy (12,) beyond what is expected, in words."""
    energy = np.maximum(slow / np.maximum(expected, 1e-9) - 1.0, 0.0)
    loudest = [k for k in np.argsort(-energy)[:3] if energy[k] > 0]
    return "errors of " + ", ".join(f"{STATE_GROUPS[k // 3]} {'xyz'[k % 3]}" for k in loudest)
