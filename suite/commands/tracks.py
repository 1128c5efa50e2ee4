"""The command `suite tracks`: list the track families, or draw a track as a picture."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from suite.common.console import Console, counted
from suite.common.options import Command
from suite.common.usage import first_paragraph
from suite.judging.trials import NO_LEVELS, is_track_file, parse_levels
from tracks.input.ranges import Seed


@dataclass(frozen=True)
class Config(Command):
    """List the track families, or draw one track as a picture."""

    track: tyro.conf.Positional[str] = ""
    """A family's name or a track file (.toml). Without it the families are listed."""
    difficulty: str = "0"
    """Level, 0 to 9; several as 0,3,9 or 0-3 or all."""
    seed: Seed = 0
    """The track's seed."""
    out: Path = Path("runs/tracks")
    """Folder for the pictures (PNG); several levels also share one."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """List the families, or draw `config.track` at each level."""
    seed_given = config.seed != Config.seed
    if not config.track:
        if config.difficulty != Config.difficulty or seed_given or config.out != Config.out:
            raise ValueError(
                "--difficulty, --seed and --out are for a picture; name its track, such as suite "
                "tracks zigzag, or leave them out to list the families"
            )
        return _list_families(console)
    from eval.quadrotor.vehicle_file import load_vehicle
    from eval.view.picture import write_grid, write_picture
    from eval.worlds.engine import family_notes, track_doubts
    from tracks.families import FAMILIES, check_family, make_track

    pictures = []
    if is_track_file(config.track):
        from tracks.formats.custom import load_track

        tracks = [load_track(Path(config.track))]
        notes = track_doubts(config.track, tracks[0], load_vehicle("racer5"))
        if config.difficulty != Config.difficulty:
            console.note(NO_LEVELS)
        if seed_given:
            console.note("nothing in a track from a file is random, so --seed does not change it")
    else:
        if config.track == "all" or "," in config.track:
            known = ", ".join(FAMILIES)
            raise ValueError(f"TRACK is {config.track!r}, allowed is one of {known}, or a file")
        check_family(config.track)
        levels = parse_levels(config.difficulty)
        tracks = [make_track(config.track, level, config.seed) for level in levels]
        notes = family_notes(config.track, levels[0], config.seed, load_vehicle("racer5"))
    for note in notes:
        console.note(note)
    for track in tracks:
        picture = config.out / f"{Path(config.track).stem}-{track.level}-{track.seed}.png"
        write_picture(picture, track)
        # `names` has the gate or obstacle that each solid belongs to.
        gates, solids = len(track.scene.gates.center_w), len(set(track.names))
        console.say(f"{picture}: {counted(gates, 'gate')}, {counted(solids - gates, 'obstacle')}")
        pictures.append({"picture": picture, "gates": gates, "obstacles": solids - gates})
    answer: dict[str, Any] = {"tracks": pictures}
    if len(tracks) > 1:
        answer["picture"] = config.out / f"{config.track}-{config.seed}.png"
        write_grid(answer["picture"], [(track, None, None) for track in tracks], columns=2)
        console.say(f"{answer['picture']}: all of them")
    return answer


def _list_families(console: Console) -> dict[str, Any]:
    """Print a line about each family, and return them for --json."""
    from tracks.families import FAMILIES, JUDGED

    families = {}
    for name in FAMILIES:
        families[name] = {"about": family_text(name), "judged": name in JUDGED}
        console.say(f"{name:<10}{families[name]['about']}")
    console.say()
    console.say("levels 0 (easy) to 9 (hard); suite tracks NAME --difficulty 9 draws one")
    return {"families": families}


def family_text(name: str) -> str:
    """Return the description of a track family, from the docstring of its code."""
    from tracks.families import FAMILIES

    make = FAMILIES.find(name)
    # A family with a module, whose function is called make, is described in the module's docstring.
    has_module = getattr(make, "__name__", "") == "make"
    text = first_paragraph((sys.modules[make.__module__] if has_module else make).__doc__)
    return text.removeprefix("Return ").removeprefix("Random: ")
