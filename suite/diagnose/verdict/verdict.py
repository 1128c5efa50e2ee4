"""What is said of a gap: none, named, named in part, or unknown."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from suite.diagnose.fit.search import Finding
from suite.diagnose.verdict.residual_structure import Rest

STRUCTURE = 1.15
"""Slow errors above their expectation by this factor are no noise."""
STRUCTURE_BY_ROTORS = 1.3
"""The same where measured rotor speeds drive the model: their noise is known less well."""
SHAPED = 0.001
"""A shape over the state that chance equals more rarely than this is structure."""
COLOURED = 1e-4
"""So is energy of a smooth push along an axis that noise gives more rarely than this."""
MOSTLY = 0.5
"""Where more than this share of the gap is left, what was named does not explain it."""


class Judgement(NamedTuple):
    """A verdict and its reasons."""

    verdict: str
    """no_gap, named, partly or unknown."""
    share_left: float
    """Structured rest over the gap."""
    where: str | None
    """What the rest goes with, in words."""


def judge(finding: Finding, rest: Rest, by_rotors: bool) -> Judgement:
    """Return the verdict on what was found and what it leaves over.

    Args:
        finding: of the search.
        rest: structure in what the named effects leave.
        by_rotors: measured rotor speeds drive the model.
    """
    expected = finding.frame.slow_freedom
    after = float(finding.slow_after.sum() / expected.sum())
    shape = rest.shapes[0] if rest.shapes else None
    shaped = shape is not None and shape.p_value <= SHAPED
    coloured = [axis for axis, p in rest.coloured.items() if p <= COLOURED and not by_rotors]
    loud = after > (STRUCTURE_BY_ROTORS if by_rotors else STRUCTURE)
    if not (loud or shaped or coloured):
        return Judgement("named" if finding.named else "no_gap", 0.0, None)
    slow = float((finding.slow_after - expected).sum())
    left = max(slow, shape.gain if shape and shaped else 0.0, 1.0)
    share = left / (left + max(finding.explained, 0.0)) if finding.named else 1.0
    where = []
    if shape is not None and shaped:
        where.append(shape.label)
    if coloured:
        where.append("a changing " + ", ".join(coloured))
    if not where:
        where.append(_loudest(finding))
    verdict = "partly" if finding.named and share <= MOSTLY else "unknown"
    return Judgement(verdict, share, "; ".join(where))


def _loudest(finding: Finding) -> str:
    groups = ("position", "attitude", "velocity", "rates")
    expected = np.maximum(finding.frame.slow_freedom.sum(axis=0), 1e-9)
    energy = np.maximum(finding.slow_after.sum(axis=0) / expected - 1.0, 0.0)
    names = [f"{groups[k // 3]} {'xyz'[k % 3]}" for k in np.argsort(-energy)[:3] if energy[k] > 0]
    return "errors of " + ", ".join(names)
