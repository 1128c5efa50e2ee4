"""A few of the judged trials flown again, before and after: a recording and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from suite.choices import parse_levels, parse_tracks
from suite.evaluate import Judgement
from suite.flying import trial_list
from suite.loop.compare import BEFORE, WITH
from suite.loop.config import LoopConfig
from suite.replay import drone_of, fly_again

if TYPE_CHECKING:
    from eval.trial import TrialSpec
    from eval.view.recording import Rollout

SHOWN = (BEFORE, WITH)
"""The policies that are shown."""
NAMES = {BEFORE: "before", WITH: "tuned with delta"}
"""What the recording calls them."""


def shown_trials(config: LoopConfig) -> list[TrialSpec]:
    """Return the first seed on every track, at the easiest and the hardest level judged."""
    levels = sorted(parse_levels(config.difficulty))
    ends = list(dict.fromkeys([levels[0], levels[-1]]))
    return trial_list(parse_tracks(config.track), ends, 1, config.seed)


def write_replays(config: LoopConfig, policies: Mapping[str, Path], folder: Path) -> None:
    """Fly the shown trials again and write recording.rrd beside `folder` and pictures into it.

    Trials are chosen by their seed, not by how they went; each is followed by the same one flown
    by the fine-tuned policy.
    """
    from eval.vehicle_file import load_vehicle
    from eval.view.picture import write_grid
    from eval.view.recording import write_recording

    trials = shown_trials(config)
    judgement = Judgement(track=config.track, vehicle=config.vehicle, seed=config.seed)
    flown: dict[str, list[Rollout]] = {}
    for variant in SHOWN:
        rollouts = fly_again(judgement, trials, str(policies[variant]))
        flown[variant] = [
            (track, flight, result._replace(policy=NAMES[variant]))
            for track, flight, result in rollouts
        ]
        columns = max(1, len(trials) // len(parse_tracks(config.track)))
        write_grid(folder / f"{variant}.png", flown[variant], columns)
    pairs = [rollout for pair in zip(*flown.values(), strict=True) for rollout in pair]
    write_recording(folder.parent / "recording.rrd", pairs, drone_of(load_vehicle(config.vehicle)))
