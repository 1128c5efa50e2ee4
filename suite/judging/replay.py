"""Fly trials of an earlier evaluation again, to show them as a recording or video (`suite view`).

A repetition of a trial gives the same flight to the bit, so an evaluation stores no flights. The
SHA-256 of policy, vehicle, sensors and track must be the same.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

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


class Replay(NamedTuple):
    """Trials flown again."""

    rollouts: list[Rollout]
    """Track, flight (with depth images) and result of each trial."""
    drone: Drone
    """The vehicle and the policy's camera, as a recording shows them."""


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


def read_digests(folder: Path, number: int) -> dict[str, str]:
    """Return the SHA-256 of the inputs of the evaluation in `folder`, by name.

    The inputs are policy `number` (from 0), the vehicle, the sensors and the tracks; see
    `evaluate.file_digests`.

    Raises:
        ValueError: if summary.json in `folder` does not have that of the policy.
    """
    path = folder / "summary.json"
    try:
        summary = read_json(path)
        return {"policy": str(summary["policies"][number]["sha256"]), **summary["sha256"]}
    except (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path}: does not say which policy was judged ({error}); run suite eval again with "
            "another --out, then view that folder"
        ) from error


def first_trials(evaluation: Evaluation) -> list[TrialSpec]:
    """Return the first trial of every track and level that `evaluation` flies."""
    tracks, levels = parse_tracks(evaluation.track), parse_levels(evaluation.difficulty)
    return trial_list(tracks, levels, 1, evaluation.seed)


def fly_again(
    evaluation: Evaluation,
    trials: list[TrialSpec],
    policy: str | None = None,
    judged: Mapping[str, str] | None = None,
) -> Replay:
    """Fly `trials` as they were judged, and return their flights.

    The policy is one of the evaluation's; None: the first one. `judged` has the expected SHA-256 of
    the inputs, from `read_digests`; None: no comparison.

    Raises:
        ValueError: if the policy, vehicle, sensors or a track has changed.
    """
    from eval.view.recording import Drone

    # Read the inputs as the evaluation did.
    trial_set = read_trial_set(evaluation)
    _, tracks, vehicle, sensors, *_ = trial_set
    name = policy or (evaluation.policies or (default_policy(),))[0]
    manner = manners(evaluation.speed, monitor=False)[0]
    loaded = load_in_manner(name, evaluation.trust, manner)
    if judged is not None:
        digests = {"policy": policy_digest(name), **file_digests(vehicle, tracks, sensors)}
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
        (track_of(tracks, trial), flights[trial], result)
        for trial, result in zip(trials, results, strict=True)
    ]
    # Flights have the camera of the policy, not that of the vehicle file.
    camera = loaded.spec.camera
    return Replay(rollouts, Drone(vehicle.body.half_size, vehicle.rotors.position, camera))


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
