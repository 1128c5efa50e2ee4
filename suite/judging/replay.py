"""Fly trials of an earlier evaluation again, to show them as a recording or video (`suite view`).

A repetition of a trial gives the same flight to the bit, so an evaluation stores no flights. The
SHA-256 of policy, vehicle, sensors and track must be the same.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from eval.judging.judge import Record
from eval.logs.flight import Flight
from eval.worlds.trial import TrialResult, TrialSpec, track_of
from suite.judging.content import policy_digest
from suite.judging.evaluate import file_digests
from suite.judging.flying import default_policy, fly_trials, load_in_manner, manners
from suite.judging.requests import Evaluation
from suite.judging.trials import parse_levels, parse_tracks, read_trial_set, trial_list
from tracks.common.toml_table import Table
from tracks.input.ranges import check_ranges
from tracks.input.reading import read_json

if TYPE_CHECKING:
    from eval.view.recording import Drone, Rollout


def read_evaluation(folder: Path) -> Evaluation:
    """Return the settings of the evaluation in `folder`, from its run.json.

    Raises:
        ValueError: if `folder` has no finished run of `suite eval`, or values of a wrong type.
    """
    path = folder / "run.json"
    try:
        config: dict[str, Any] = dict(read_json(path)["config"])
        names = {field.name for field in dataclasses.fields(Evaluation)}
        fits = "policies" in config and set(config) <= names
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not the record of a run ({error})") from error
    if not fits:
        raise ValueError(f"{path}: not a run of suite eval; give the --out of one")
    evaluation = Table(str(path), "config", config).read(Evaluation)
    check_ranges(evaluation, f"{path}: ")
    return evaluation


def first_trials(evaluation: Evaluation) -> list[TrialSpec]:
    """Return the first trial of every track and level that `evaluation` flies."""
    tracks, levels = parse_tracks(evaluation.track), parse_levels(evaluation.difficulty)
    return trial_list(tracks, levels, 1, evaluation.seed)


def fly_again(
    evaluation: Evaluation,
    trials: list[TrialSpec],
    policy: str | None = None,
    judged: Mapping[str, str] | None = None,
) -> tuple[list[Rollout], Drone]:
    """Fly `trials` as they were judged; return them, and the vehicle with the policy's camera.

    A rollout has the track, the flight (with depth images) and the result of a trial. The policy is
    one of the evaluation's; None: the first one. `judged` has the expected SHA-256 of the
    policy and of `evaluate.file_digests`; None: no comparison.

    Raises:
        ValueError: if the policy, vehicle, sensors or a track has changed.
    """
    from eval.view.recording import Drone

    # Read the inputs as the evaluation did.
    trial_set = read_trial_set(evaluation)
    name = policy or (evaluation.policies or (default_policy(),))[0]
    manner = manners(evaluation.speed, monitor=False)[0]
    loaded = load_in_manner(name, evaluation.trust, manner)
    if judged is not None:
        digests = {"policy": policy_digest(name), **file_digests(trial_set)}
        sources = {"policy": name, "vehicle": evaluation.vehicle, "sensors": evaluation.sensors}
        _refuse_changed(sources, digests, judged)
    # Fly, and keep the flights.
    flights: dict[TrialSpec, Flight] = {}

    def keep(result: TrialResult, flight: Flight | None) -> None:
        if flight is not None:
            flights[result.trial] = flight

    record = Record(depth=True)
    results = fly_trials(loaded, evaluation, trial_set, 1, trials, keep, record)
    rollouts = [
        (track_of(trial_set.tracks, trial), flights[trial], result)
        for trial, result in zip(trials, results, strict=True)
    ]
    # Flights have the camera of the policy, not that of the vehicle file.
    vehicle, camera = trial_set.vehicle, loaded.spec.camera
    return rollouts, Drone(vehicle.body.half_size, vehicle.rotors.position, camera)


def _refuse_changed(
    sources: Mapping[str, str], digests: Mapping[str, str], judged: Mapping[str, str]
) -> None:
    """Refuse inputs that changed since the evaluation, because the flights would differ.

    All arguments are by input: path or name, SHA-256 now, and SHA-256 in the evaluation.
    """
    for item in dict.fromkeys([*digests, *judged]):  # perfect sensors have no digest
        if digests.get(item) != judged.get(item):
            label = f"{item} {sources[item]}" if item in sources else item
            raise ValueError(
                f"{label}: has changed since these trials were judged, so the flights would "
                "differ; restore the judged version, or run suite eval again with another --out, "
                "then view that folder"
            )
