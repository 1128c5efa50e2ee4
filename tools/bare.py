"""Run a command of the suite on the judged tracks without their obstacles.

    python tools/bare.py eval --policy race --difficulty 0,3,6,9 --trials 25 --workers 1

Gates and starts are those of `suite eval` with the same seeds. Nothing hides a gate, and the policy
knows the positions of the next two gates. So the laps show what sight of obstacles costs.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from unittest.mock import patch

import numpy as np

from suite import cli
from tracks.families import FAMILIES, JUDGED
from tracks.families.layout import Layout


def bare(make: Callable[[float, np.random.Generator], Layout]) -> Callable[..., Layout]:
    """Return the family `make` with its gates and their frames only."""

    def layout(d: float, rng: np.random.Generator) -> Layout:
        full = make(d, rng)
        bars = int(np.prod(full.scene.gates.opening_g.shape[:2]))
        kept = {"boxes": bars, "cylinders": 0, "capsules": 0, "spheres": 0}
        parts = {kind: getattr(full.scene, kind) for kind in kept}
        solids = {
            kind: type(part)(*(field[: kept[kind]] for field in part))
            for kind, part in parts.items()
        }
        scene = full.scene._replace(**solids, triangles=full.scene.triangles[:0])
        return full._replace(scene=scene, names=full.names[:bars])

    return layout


def main() -> int:
    """Run the command with the judged families replaced, in this process only."""
    with patch.dict(FAMILIES._values, {name: bare(FAMILIES[name]) for name in JUDGED}):
        return cli.main(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
