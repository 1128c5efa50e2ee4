"""Fly judged trials again to look at them: a trial repeats to the bit, so no flight is stored."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from suite.common.choices import parse_levels, parse_tracks
from suite.common.console import Console
from suite.judging.evaluate import Judgement
from suite.judging.flying import custom_tracks, default_policy, trial_list

if TYPE_CHECKING:
    from eval.logs.flight import Flight
    from eval.vehicles.vehicle import Vehicle
    from eval.view.recording import Drone, Rollout
    from eval.worlds.trial import TrialResult, TrialSpec


def read_judgement(folder: Path) -> Judgement:
    """Return what `suite eval --out folder` judged.

    Raises:
        ValueError: where `folder` holds no finished judgement.
    """
    path = folder / "run.json"
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        config: dict[str, Any] = record["config"]
        known = {field.name for field in dataclasses.fields(Judgement)}
        fits = record["config_type"].endswith(".Judgement") and set(config) <= known
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not the record of a run ({error})") from error
    if not fits:
        raise ValueError(f"{path}: not a run of suite eval; give the --out of one")
    return Judgement(**{**config, "policies": tuple(config["policies"])})


def first_trials(judgement: Judgement) -> list[TrialSpec]:
    """Return the first trial of every track and level that `judgement` flies."""
    tracks, levels = parse_tracks(judgement.track), parse_levels(judgement.difficulty)
    return trial_list(tracks, levels, 1, judgement.seed)


def fly_again(
    judgement: Judgement, trials: list[TrialSpec], policy: str | None = None
) -> list[Rollout]:
    """Return track, flight (with the depth images) and result of each of `trials`.

    Args:
        judgement: what the trials are part of.
        trials: which.
        policy: one of the judgement's; its first if None.
    """
    from eval.judging.guard import ActionLimits
    from eval.judging.judge import JudgeOptions, Record, fly
    from eval.quadrotor.vehicle_file import load_vehicle
    from eval.worlds.trial import track_of
    from policies.policy import load_policy

    name = policy or (judgement.policies or (default_policy(),))[0]
    tracks = custom_tracks(parse_tracks(judgement.track))
    flights: dict[TrialSpec, Flight] = {}

    def keep(result: TrialResult, flight: Flight | None) -> None:
        if flight is not None:
            flights[result.trial] = flight

    results = fly(
        load_policy(name, judgement.trust),
        trials,
        load_vehicle(judgement.vehicle),
        judgement.world,
        JudgeOptions(processes=1, limits=ActionLimits(deadline_s=judgement.deadline_s)),
        keep,
        Record(depth=True),
        tracks,
    )
    return [
        (track_of(tracks, trial), flights[trial], result)
        for trial, result in zip(trials, results, strict=True)
    ]


def drone_of(vehicle: Vehicle) -> Drone:
    """Return how a recording shows `vehicle`."""
    from eval.view.recording import Drone

    return Drone(vehicle.body.half_size, vehicle.rotors.position, vehicle.camera)


def record_first_trials(judgement: Judgement, path: Path, console: Console) -> None:
    """Write a rerun recording of the first trial of every track and level to `path`."""
    from eval.quadrotor.vehicle_file import load_vehicle
    from eval.view.recording import write_recording

    rollouts = fly_again(judgement, first_trials(judgement))
    write_recording(path, rollouts, drone_of(load_vehicle(judgement.vehicle)))
    console.say(f"written: {path} (open it with: rerun {path})")
