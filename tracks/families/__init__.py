"""Track families by name, and the tracks that they draw.

A family is a rule that draws a track: a function `make(d, rng) -> Layout` of the difficulty `d` and
a random generator. Another package adds one with an entry point of the group
`diffracing_suite.tracks`. A program adds one for its own process with
`FAMILIES.register(name, make)`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from numbers import Integral

import numpy as np

from tracks.common.names import Registry
from tracks.families import judged, random
from tracks.families.layout import GATE_COUNT, Layout
from tracks.geometry.scene import Counts, counts
from tracks.input.ranges import check_type, shown
from tracks.track import Track
from tracks.track_check import check_track

FAMILIES: Registry[Callable[[float, np.random.Generator], Layout]] = Registry(
    "track family",
    "diffracing_suite.tracks",
    {
        "zigzag": judged.zigzag,
        "circular": judged.circular,
        "ellipse": judged.ellipse,
        "random": random.make,
    },
    lambda _, make: (
        None if callable(make) else f"{shown(make)}; must be a function (d, rng) -> Layout"
    ),
)
"""Name of a family -> function that draws its tracks."""
JUDGED = ("zigzag", "circular", "ellipse")
"""The families on which policies are evaluated; they are trained on `random`."""
LEVELS = range(10)
"""Difficulty levels, 0 (easy) to 9 (hard)."""
MAX_COUNTS = Counts(boxes=70, cylinders=15, capsules=12, spheres=12)
"""Largest number of solids of each kind, over all families and levels. A track has 32 bars of gate
frames, and 7 stretches (parts of the track between two gates). Each stretch has at most 3 plates, 3
small solids, 1 pillar and 4 ground objects. Small solids and ground objects are distributed evenly
over the kinds."""


def make_track(family: str, level: int, seed: int) -> Track:
    """Return the track of (family, level, seed), which determine it completely.

    The level is 0 (easy) to 9 (hard); the difficulty is (level + U(0, 1)) / 10.

    Raises:
        ValueError: where the family is unknown, fails, does not return a Layout, or draws random
            numbers without the generator; the level is out of range or the seed negative; the track
            has more solids than `MAX_COUNTS`, or is not possible (`tracks.track_check`).
    """
    check_family(family)
    levels, seeds = "a whole number from 0 to 9", "a whole number, 0 or more"
    check_type("level", level, (Integral,), levels)
    check_type("seed", seed, (Integral,), seeds)
    if level not in LEVELS:
        raise ValueError(f"level is {level!r}, allowed is {levels}")
    if seed < 0:
        raise ValueError(f"seed is {seed!r}, allowed is {seeds}")
    level, seed = int(level), int(seed)
    rng = np.random.default_rng(np.random.SeedSequence([seed, level, *family.encode()]))
    d = (level + rng.random()) / 10
    layout = _layout(family, d, rng)
    if not isinstance(layout, Layout):
        raise ValueError(
            f"track family {family!r} returns {type(layout).__name__}, must return a Layout; "
            "tracks.families.layout.build makes one"
        )
    track = Track(family, level, seed, d, *layout)
    if family not in FAMILIES.own:
        check_track(track)
        _check_size(track)
        _check_repeats(family)
    return track


def random_track(
    difficulty: float, rng: np.random.Generator, mix: random.Mix = random.MIX
) -> Track:
    """Return a new track of the training distribution; its `seed` is 0.

    The difficulty is in [0, 1]; `mix` has probabilities of sharp turns and of obstacles.

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


def _layout(family: str, d: float, rng: np.random.Generator) -> Layout:
    """Return what a family draws; an error in code of another program names the family."""
    try:
        return FAMILIES[family](d, rng)
    except Exception as error:  # such code may raise anything
        if family in FAMILIES.own:
            raise
        text = (str(error) or "?").splitlines()[0]
        raise ValueError(
            f"track family {family!r} fails with {type(error).__name__}: {text}; correct its "
            f"function make(d, rng), here for d = {d:.3f}"
        ) from error


@cache
def _check_repeats(family: str) -> None:
    """Refuse a family that draws two different tracks from equal random generators."""
    one, other = (_layout(family, 0.5, np.random.default_rng(0)).scene for _ in range(2))
    pairs = zip(one[:5], other[:5], strict=True)
    if not all(np.array_equal(a, b) for parts in pairs for a, b in zip(*parts, strict=True)):
        raise ValueError(
            f"track family {family!r} draws two different tracks from one seed; draw all random "
            "numbers from its argument rng, and keep nothing between calls"
        )


def _check_size(track: Track) -> None:
    """Refuse a track with more gates or solids than the simulators' scenes have space for."""
    gates, corners = track.scene.gates.opening_g.shape[:2]
    if gates > GATE_COUNT or corners > 4:
        raise ValueError(
            f"track family {track.family!r}: {gates} gates of {corners} corners; allowed are at "
            f"most {GATE_COUNT} of 4 (a track file may have more)"
        )
    for kind, count, most in zip(Counts._fields, counts(track.scene), MAX_COUNTS, strict=False):
        if count > most:
            raise ValueError(
                f"track family {track.family!r}: {count} {kind}; allowed are at most {most} "
                "(a track file may have more)"
            )
