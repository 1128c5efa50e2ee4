"""A few of the judged trials flown again, before and after: a recording and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from suite.common.choices import parse_levels, parse_tracks
from suite.judging.evaluate import Judgement
from suite.judging.flying import trial_list
from suite.judging.replay import drone_of, fly_again

if TYPE_CHECKING:
    from eval.view.recording import Rollout
    from eval.worlds.trial import TrialSpec


def shown_trials(judgement: Judgement) -> list[TrialSpec]:
    """Return the first seed on every track, at the easiest and the hardest level judged."""
    levels = sorted(parse_levels(judgement.difficulty))
    ends = list(dict.fromkeys([levels[0], levels[-1]]))
    return trial_list(parse_tracks(judgement.track), ends, 1, judgement.seed)


def write_replays(
    judgement: Judgement, shown: Mapping[str, tuple[str, Path]], folder: Path
) -> None:
    """Fly the shown trials again and write recording.rrd beside `folder` and pictures into it.

    Trials are chosen by their seed, not by how they went; each is followed by the same one flown
    by the other policies.

    Args:
        judgement: whose trials they are.
        shown: by the name of the picture, what the recording calls the policy and where it is.
        folder: for NAME.png.
    """
    from eval.quadrotor.vehicle_file import load_vehicle
    from eval.view.picture import write_grid
    from eval.view.recording import write_recording

    trials = shown_trials(judgement)
    flown: dict[str, list[Rollout]] = {}
    for name, (label, policy) in shown.items():
        rollouts = fly_again(judgement, trials, str(policy))
        flown[name] = [
            (track, flight, result._replace(policy=label)) for track, flight, result in rollouts
        ]
        columns = max(1, len(trials) // len(parse_tracks(judgement.track)))
        write_grid(folder / f"{name}.png", flown[name], columns)
    pairs = [rollout for pair in zip(*flown.values(), strict=True) for rollout in pair]
    drone = drone_of(load_vehicle(judgement.vehicle))
    write_recording(folder.parent / "recording.rrd", pairs, drone)
