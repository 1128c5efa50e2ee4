"""Track families by name; each is a function `make(d, rng) -> Layout` with an entry here.

Another package adds one with an entry point of the group `diffracing_suite.tracks`, a program for
its own process with `FAMILIES.register(name, make)`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tracks.common.names import Registry
from tracks.families import judged, random
from tracks.families.layout import GATE_COUNT, Layout
from tracks.geometry.scene import Counts, counts
from tracks.track import Track


def _wrong(name: str, make: Any) -> str | None:
    return None if callable(make) else f"{make!r}; must be a function (d, rng) -> Layout"


FAMILIES: Registry[Callable[[float, np.random.Generator], Layout]] = Registry(
    "track family",
    "diffracing_suite.tracks",
    {
        "zigzag": judged.zigzag,
        "circular": judged.circular,
        "ellipse": judged.ellipse,
        "random": random.make,
    },
    _wrong,
)
JUDGED = ("zigzag", "circular", "ellipse")
"""The families of the tables; `random` is what policies are trained on."""
LEVELS = range(10)
MAX_COUNTS = Counts(boxes=70, cylinders=15, capsules=12, spheres=12)
"""Most solids of each kind over all families and levels: 32 frame bars, and 7 stretches with at
most 3 plates, 3 small solids, 1 pillar and 4 ground objects, whose kinds are dealt out evenly."""


def make_track(family: str, level: int, seed: int) -> Track:
    """Return the track of (family, level, seed), which determine it completely.

    Args:
        family: a name in `FAMILIES`.
        level: 0 (easy) to 9 (hard); the difficulty is (level + U(0, 1)) / 10.
        seed: 0 or more.

    Raises:
        ValueError: where the family is unknown or returns no layout, the level is out of range or
            the seed negative, or where the track has more solids than the simulators' scenes hold.
    """
    check_family(family)
    if level not in LEVELS:
        raise ValueError(f"level is {level!r}, allowed is a whole number from 0 to 9")
    if seed != int(seed) or seed < 0:
        raise ValueError(f"seed is {seed!r}, allowed is a whole number, 0 or more")
    level, seed = int(level), int(seed)
    rng = np.random.default_rng(np.random.SeedSequence([seed, level, *family.encode()]))
    d = (level + rng.random()) / 10
    layout = FAMILIES[family](d, rng)
    if not isinstance(layout, Layout):
        raise ValueError(
            f"track family {family!r} returns {type(layout).__name__}, must return a Layout; "
            "tracks.families.layout.build makes one"
        )
    track = Track(family, level, seed, d, *layout)
    _check_size(track)
    return track


def random_track(
    difficulty: float, rng: np.random.Generator, mix: random.Mix = random.MIX
) -> Track:
    """Return a fresh track of the training distribution; `seed` of the result is 0.

    Args:
        difficulty: d in [0, 1].
        rng: source of randomness.
        mix: shares of tracks with sharp turns and with obstacles.

    Raises:
        ValueError: where the difficulty is outside [0, 1].
    """
    if not 0.0 <= difficulty <= 1.0:
        raise ValueError(f"difficulty is {difficulty!r}, allowed is 0 to 1")
    level = min(int(difficulty * 10), LEVELS[-1])
    return Track("random", level, 0, difficulty, *random.make(difficulty, rng, mix))


def check_family(family: str) -> None:
    """Raise a ValueError with the closest name where `family` is unknown."""
    FAMILIES.find(family)


def _check_size(track: Track) -> None:
    gates, corners = track.scene.gates.opening_g.shape[:2]
    if gates > GATE_COUNT or corners > 4:
        raise ValueError(
            f"track family {track.family!r}: {gates} gates of {corners} corners; allowed are at "
            f"most {GATE_COUNT} of 4 (a track file may have more)"
        )
    for kind, there, most in zip(Counts._fields, counts(track.scene), MAX_COUNTS, strict=False):
        if there > most:
            raise ValueError(
                f"track family {track.family!r}: {there} {kind}; allowed are at most {most} "
                "(a track file may have more)"
            )
