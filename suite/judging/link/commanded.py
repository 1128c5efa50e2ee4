"""`suite fly`: simulated flights compared with the judge's trials, or one flight over a real link.

The judge is the simulator that scores policies (`eval.judging.judge`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eval.judging.monitor import Monitored
from eval.worlds.trial import Rules
from policies.block_policy import BlockPolicy, for_one_row
from policies.policy import Policy
from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.common.provenance import refuse_other_run, write_run_record
from suite.judging.flying import (
    Course,
    about_policy,
    default_policy,
    load_in_manner,
    read_course,
    refuse_one_name,
)
from suite.judging.link.companion import FINISHED, Companion
from suite.judging.link.flights import Flight, delays, fly_link, fly_simulated, totals, write_log
from suite.judging.link.messages import Wire, dialect
from suite.judging.link.server import COMPANION, VEHICLE, WAIT_S
from suite.judging.link.udp import UdpLink
from suite.judging.link.watchdog import Limits
from suite.judging.requests import Evaluation, manners
from tracks.common.files import write_json
from tracks.common.grid import rich_table, table
from tracks.common.provenance import stamp

FLY = "fly.json"


@dataclass(frozen=True)
class LinkFlights:
    """The settings of flights over a link, for run.json."""

    evaluation: Evaluation
    """The trials."""
    policy: dict[str, Any]
    """Name, source and digest of the policy."""
    limits: Limits
    """Of the watchdog."""
    link: str
    """The address, or "simulated"."""


def fly_commanded(
    evaluation: Evaluation,
    policy: str,
    link: str,
    limits: Limits,
    out: Path,
    console: Console,
    key: bytes | None = None,
) -> dict[str, Any]:
    """Fly and write logs and fly.json into `out`.

    Raises:
        ValueError: for invalid options, before the first flight.
        WorkFailed: if pymavlink is missing, or no vehicle answers.
    """
    dialect()
    course = read_course(evaluation, real_time=True)
    refuse_one_name({trial.track for trial in course.trials})
    name = policy or default_policy()
    # The commanded speed is part of how the policy is loaded; the monitor is added below.
    (plain,) = manners(evaluation.speed, monitor=False)
    loaded = load_in_manner(name, evaluation.trust, plain)
    # One vehicle needs no block of 64 rows; the judge keeps blocks, for equal rounding.
    flying = for_one_row(loaded) if isinstance(loaded, BlockPolicy) else loaded
    if evaluation.monitor:
        loaded, flying = Monitored(loaded), Monitored(flying)
    settings = LinkFlights(evaluation, about_policy(name, loaded), limits, link or "simulated")
    refuse_other_run(out, settings)
    rules = Rules(time_limit_s=evaluation.time_limit_s)
    # Before the flights, since the judge may refuse the policy.
    judged = [] if link else _judged(loaded, course, rules)
    out.mkdir(parents=True, exist_ok=True)
    interrupt = None
    if link:
        found = _real(flying, course, link, limits, out, console, key)
    else:
        flights: list[Flight] = []
        try:
            for flight in fly_simulated(flying, course, rules, limits, out, console):
                flights.append(flight)
        except KeyboardInterrupt as error:
            interrupt = error
        found = {**totals(flights, limits), "judge_successes": sum(judged[: len(flights)])}
        found["flights"] = [flight.row for flight in flights]
        _show(found, flights, console)
    about = {"policy": settings.policy, "limits": limits, "link": settings.link}
    if isinstance(flying, Monitored):
        found["interventions"] = flying.interventions
    answer = {**stamp(1, evaluation.seed), **about, **found}
    write_json(out / FLY, answer)
    write_run_record(out, settings, evaluation.seed)
    if interrupt is not None:
        raise interrupt
    return {**answer, "out": str(out)}


def _judged(policy: Policy, course: Course, rules: Rules) -> list[bool]:
    """Return whether the judge's flight of each trial succeeds."""
    from eval.judging.judge import JudgeOptions, fly

    options = JudgeOptions(slots=min(16, len(course.trials)), workers=1, rules=rules)
    results = fly(policy, course.trials, course.vehicle, options=options, tracks=course.tracks)
    return [result.success for result in results]


def _real(
    policy: Policy,
    course: Course,
    address: str,
    limits: Limits,
    out: Path,
    console: Console,
    key: bytes | None,
) -> dict[str, Any]:
    from eval.worlds.trial import track_of
    from suite.judging.link.flights import warm_up

    if len(course.trials) != 1:
        raise ValueError(
            f"--link flies one flight, and {len(course.trials)} are asked for; give one track, "
            "one level and --trials 1"
        )
    if (out / FLY).is_file() or any(out.glob("*.parquet")):
        raise ValueError(f"--out {out} holds an earlier flight; give each one a folder of its own")
    (trial,) = course.trials
    warm_up(policy)
    wire = Wire(COMPANION, VEHICLE, key)
    link = UdpLink(address, wire.speaks)
    track = track_of(course.tracks, trial)
    companion = Companion(policy, track, course.vehicle, wire, time.monotonic, limits)
    console.say(
        f"waiting for states and images on {address}; Ctrl-C returns control to the autopilot"
    )
    try:
        fly_link(companion, link)
    except KeyboardInterrupt:
        link.send(companion.end("the operator"))
    except Exception as error:
        link.send(companion.end(f"{type(error).__name__}: {error}"))
        raise
    finally:
        link.close()
        row = {**trial._asdict(), "handed_over": companion.over}
        file = write_log(companion, row, out)
    if not companion.rows:
        why = f"no vehicle sent a state (ODOMETRY) and a depth image within {WAIT_S:g} s"
        if companion.over is not None:
            why = f"handed over before the first set point: {companion.over}"
        elif companion.wrong_image_size:
            why += f" ({companion.wrong_image_size})"
        raise WorkFailed(f"{address}: {why}; see docs/fly.md, 'When it hands over'")
    console.say(f"handed over: {companion.over}; log: {file}")
    if link.strangers:
        console.note(f"{link.strangers} datagrams of others than the vehicle were left out")
    _warn_of_missed(companion.missed_decisions, console)
    return {
        **delays(companion.rows, limits.deadline_s),
        "late_answers": companion.late_answers,
        "missed_decisions": companion.missed_decisions,
        "gates_passed": companion.gate,
        "success": companion.over == FINISHED,
        "strangers": link.strangers,
        "flights": [{**row, "file": file}],
    }


def _show(found: dict[str, Any], flights: list[Flight], console: Console) -> None:
    headers = ("delay", "median [ms]", "p99 [ms]", "longest [ms]")
    names = {
        "answer_ms": "state's arrival to set point",
        "decision_ms": "the same where the policy decided",
        "state_age_ms": "state's stamp to set point",
        "image_age_ms": "image's arrival to decision",
    }
    lines = [
        [text, *(f"{found[key][part]:.2f}" for part in ("median", "p99", "max"))]
        for key, text in names.items()
        if key in found
    ]
    if lines:
        console.show(rich_table(table(headers, lines)))
    count = found["trials"]
    console.say(
        f"{found['successes']} of {count} finished; the judge's: {found['judge_successes']}"
    )
    for flight in flights:
        if flight.row["handed_over"]:
            console.say(f"seed {flight.row['seed']}: handed over: {flight.row['handed_over']}")
    if found["vehicle_slips"]:
        console.note(
            f"warning: the simulated vehicle was late {found['vehicle_slips']} times; run again on "
            "a free machine"
        )
    _warn_of_missed(found["missed_decisions"], console)


def _warn_of_missed(count: int, console: Console) -> None:
    if count:
        console.note(
            f"warning: {count} decisions were missed: no state came in their time (send ODOMETRY "
            "several times as often as the policy decides), or the policy took longer than one "
            "decision period"
        )
