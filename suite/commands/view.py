"""The command `suite view`: fly trials again, and write a recording, pictures and a video."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import tyro

from suite.common.console import Console, command_line, counted
from suite.common.options import Advanced, Command
from tracks.common.files import check_place
from tracks.common.names import unknown_name
from tracks.input.ranges import Range, Seed

if TYPE_CHECKING:
    from eval.view.recording import Rollout
    from eval.worlds.trial import TrialResult, TrialSpec
    from suite.judging.requests import Evaluation


TRIALS = "trials.parquet"
"""Name of the file with the trials of a suite eval."""


@dataclass(frozen=True)
class Config(Command):
    """Fly trials of a suite eval again; write a recording for rerun, pictures and a video."""

    run: tyro.conf.Positional[str]
    """The folder (--out) of a suite eval, or a policy: a shipped name, a checkpoint's folder or a
    file."""
    pick: Literal["first", "failed", "passed"] = "first"
    """Which trials of the run: the first ones, or the first that failed or that succeeded."""
    policy: str | None = None
    """If RUN is a suite eval: its policy, named as in its table, whose trials are shown. Without it
    the first policy with such trials."""
    count: Annotated[int, Range(1, 1000)] = 3
    """Largest number of trials."""
    track: str = "all"
    """If RUN is a policy: zigzag, circular, ellipse, all of these, random, a track file, or
    several."""
    difficulty: str = "3"
    """If RUN is a policy: level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    vehicle: str = "reference"
    """If RUN is a policy: a shipped vehicle's name or a vehicle file (.toml)."""
    seed: Seed = 0
    """If RUN is a policy: the trials' seed."""
    speed: Annotated[float, Range(0.0, 1.0)] | None = None
    """For a policy with a speed input: 0 (careful) to 1 (a race). Without it the policy's own."""
    out: Path = Path("runs/view")
    """Folder for the recording (trials.rrd), the pictures (PNG), the video and the GIF."""
    video: bool = False
    """Also write a video (MP4) of the first trial; takes about its length."""
    gif: bool = False
    """Also write a small GIF of the first trial, for a page."""
    trust: Advanced[bool] = False
    """Also load policy files that can run code on this machine (.pt2, .pt, .c), those of a run
    included."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Fly the chosen trials again and write the files."""
    recording = config.out / "trials.rrd"
    check_place(recording)
    chosen = _choose_trials(config, console)
    from eval.view.picture import write_picture
    from eval.view.recording import write_recording
    from suite.judging.replay import fly_again
    from suite.judging.trials import refuse_equal_names

    refuse_equal_names({trial.track for trial in chosen.trials})
    count = len(chosen.trials)
    console.note(f"flying {counted(count, 'trial')} of {chosen.label}")
    rollouts, drone = fly_again(chosen.evaluation, chosen.trials, judged=chosen.digests)
    write_recording(recording, rollouts, drone)
    written = [recording]
    for rollout in rollouts:
        written.append(write_picture(config.out / f"{_name(rollout)}.png", *rollout))
        result = rollout[2]
        console.say(
            f"{_name(rollout)}: {counted(result.gates_passed, 'gate')}, {result.ending} after "
            f"{result.time_s:.1f} s"
        )
        before = chosen.judged.get(result.trial, result)
        if (before.ended_by, before.time_s) != (result.ended_by, result.time_s):
            console.note(
                f"warning: {_name(rollout)} was judged as {before.ended_by} after "
                f"{before.time_s:.1f} s; this machine or version flies it otherwise"
            )
    for ending, is_requested in ((".mp4", config.video), (".gif", config.gif)):
        if is_requested:
            name = f"{_name(rollouts[0])}{ending}"
            written.append(_write_video(config.out / name, rollouts[0], console))
    for path in written:
        console.say(f"written: {path}")
    console.say(f"open the recording with: {command_line('rerun', recording)}")
    return {"written": written, "trials": [result for _, _, result in rollouts]}


def _write_video(path: Path, rollout: Rollout, console: Console) -> Path:
    """Write a video or a GIF, by the ending of `path`, and return the path."""
    from eval.view.video import SMALL, VideoOptions, frame_times, write_video

    options, flight = SMALL if path.suffix == ".gif" else VideoOptions(), rollout[1]
    frames = len(frame_times(flight, options)) if len(flight.time_s) else 0
    with console.progress("video", frames) as show:
        return write_video(path, *rollout, options, show)


def _name(rollout: Rollout) -> str:
    """Return the name of a trial for its files; a rollout is (track, flight, result)."""
    result = rollout[2]
    return f"{Path(result.track).stem}-{result.difficulty}-{result.seed}"


class _Chosen(NamedTuple):
    """The trials to fly again."""

    evaluation: Evaluation
    """Its only policy flies them."""
    label: str
    """Name of the policy."""
    trials: list[TrialSpec]
    digests: dict[str, str] | None
    """SHA-256 of the inputs of the evaluation; None if RUN is a policy."""
    judged: dict[TrialSpec, TrialResult]
    """Results of the evaluation; empty if RUN is a policy."""


def _choose_trials(config: Config, console: Console) -> _Chosen:
    """Return the trials that the options choose."""
    from eval.logs.flight_log import logs_in
    from policies.formats.checkpoint import CONFIG
    from policies.shipped import locate, names
    from suite.judging.flying import default_policy, manners
    from suite.judging.replay import first_trials, read_evaluation
    from suite.judging.requests import Evaluation

    folder = Path(config.run)
    folder = folder.parent if folder.name == TRIALS else folder
    if not (folder / TRIALS).is_file():
        if any(folder.glob("journal-*.jsonl")):
            raise ValueError(
                f"{folder}: this suite eval is not finished; repeat its command to fly the "
                "remaining trials, then view it"
            )
        reason = f"{folder} is not a finished run of suite eval"
        config.refuse_unused(("pick", "policy"), reason)
        log = next(iter(logs_in(folder)), folder)
        if log.suffix in (".parquet", ".csv") and not (folder / CONFIG).exists():
            raise ValueError(
                f"{log} is a flight log, and suite view flies trials; give the policy of the "
                "flights (of a suite collect it is in flights.json, with the --track, "
                "--difficulty, --vehicle and --seed), or the --out folder of a suite eval"
            )
        if not locate(config.run).exists():
            raise ValueError(
                f"{unknown_name('RUN', config.run, names())} The --out folder of a suite eval, a "
                "checkpoint's folder or a policy file is allowed as well."
            )
        evaluation = Evaluation(
            policies=(config.run,),
            track=config.track,
            difficulty=config.difficulty,
            seed=config.seed,
            vehicle=config.vehicle,
            trust=config.trust,
            speed=() if config.speed is None else (config.speed,),
        )
        trials = first_trials(evaluation)
        if len(trials) > config.count:
            console.note(f"shown are {config.count} of {len(trials)} trials; --count shows more")
        return _Chosen(evaluation, config.run, trials[: config.count], None, {})
    from suite.judging.comparing import read_runs

    reason = f"{folder} is a run, whose trials are flown again unchanged"
    config.refuse_unused(("track", "difficulty", "vehicle", "seed", "speed"), reason)
    # A folder's record must not decide that the files that it names may run code.
    evaluation = replace(read_evaluation(folder), trust=config.trust)
    # The runs are in the order of the evaluation's entries, and monitored ones are the last.
    sources = evaluation.policies or (default_policy(),)
    entries = [(each, source) for each in manners(evaluation.speed, False) for source in sources]
    runs = read_runs(folder)[: len(entries)]
    results = [result for run in runs for result in run.rows.values()]
    labels = list(dict.fromkeys(result.policy for result in results))
    if config.policy not in (None, *labels):
        raise unknown_name("--policy", str(config.policy), labels)
    if config.pick != "first":
        results = [result for result in results if result.success == (config.pick == "passed")]
    found = [label for label in labels if any(result.policy == label for result in results)]
    label = config.policy or next(iter(found), None)
    if label not in found:
        of = f" of {config.policy}" if config.policy else ""
        raise ValueError(
            f"--pick {config.pick}: {folder} holds no such trial{of}; leave --pick out to view the "
            "first ones"
        )
    if others := ", ".join(each for each in found if each != label):
        console.note(f"shown are trials of {label}; --policy selects another of: {others}")
    number = labels.index(label)
    (manner, source), run = entries[number], runs[number]
    speed = () if manner.speed is None else (manner.speed,)
    evaluation = replace(evaluation, policies=(source,), speed=speed)
    judged = {result.trial: result for result in results if result.policy == label}
    digests = {"policy": run.digest, **run.inputs}
    return _Chosen(evaluation, label, list(judged)[: config.count], digests, judged)
