"""The work of `suite fly`: fly a policy over a MAVLink link, simulated or to a real vehicle.

Simulated flights are compared with the same trials of the judge, which flies without a link. The
companion hands over when it stops sending commands; then the autopilot flies alone.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from eval.judging.monitor import Monitored
from eval.judging.policy_checks.faults import notes_of
from eval.worlds.trial import Rules, track_of
from policies.block_policy import BlockPolicy, for_one_row
from policies.policy import Policy
from policies.spec import PolicyError
from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.common.provenance import refuse_other_run, write_run_record
from suite.judging.content import PolicyContent
from suite.judging.flying import (
    default_policy,
    fly_trials,
    load_in_manner,
    manners,
    policy_record,
)
from suite.judging.link.companion import FINISHED, Companion
from suite.judging.link.flights import (
    Flight,
    delays,
    fly_link,
    fly_simulated,
    totals,
    warm_up,
    write_log,
)
from suite.judging.link.messages import Wire, dialect
from suite.judging.link.server import COMPANION, VEHICLE, WAIT_S
from suite.judging.link.udp import UdpLink
from suite.judging.link.watchdog import Limits, refuse_high_floor
from suite.judging.requests import Evaluation
from suite.judging.trials import TrialSet, read_trial_set, refuse_equal_names, show_notes
from tracks.common.files import write_json
from tracks.common.grid import rich_table, table
from tracks.common.provenance import stamp

FLY = "fly.json"
"""Name of the result file in the output folder."""
REPEATED_SHARE = 0.1
"""Share of decisions without a new image, above which there is a warning. A camera with a clock of
its own repeats a few."""


@dataclass(frozen=True)
class LinkFlights:
    """The settings of flights over a link, for run.json."""

    evaluation: Evaluation
    """Settings of the trials."""
    policy: dict[str, Any]
    """Name, source and SHA-256 of the policy."""
    limits: Limits
    """Limits of the watchdog."""
    link: str
    """Address of the real vehicle, or "simulated"."""


def fly_over_link(
    evaluation: Evaluation,
    policy: str,
    link: str,
    limits: Limits,
    out: Path,
    console: Console,
    key: bytes | None = None,
) -> dict[str, Any]:
    """Fly, and write logs and fly.json into `out`.

    "" as the policy flies the default one. "" as the link flies simulated vehicles, and an address
    a real one. The 32 bytes of `key` sign the messages to a real vehicle; None sends unsigned ones.

    Returns:
        The contents of fly.json, and `out`.

    Raises:
        ValueError: for invalid options or a policy that commands motors, before the first flight.
        WorkFailed: if pymavlink is missing, no vehicle answers, or the simulated vehicle's process
            dies; fly.json then has the flights before.
    """
    dialect()
    trial_set = read_trial_set(evaluation, repeated=True)
    refuse_equal_names({trial.track for trial in trial_set.trials})
    for trial in trial_set.trials:
        track = track_of(trial_set.tracks, trial)
        points_w = np.vstack([track.start_pos_w, track.scene.gates.center_w])
        refuse_high_floor(points_w, limits)
    name = policy or default_policy()
    # The commanded speed is part of how the policy is loaded; the monitor is added below.
    (plain,) = manners(evaluation.speed, monitor=False)
    loaded, content = load_in_manner(name, evaluation.trust, plain), PolicyContent.of(name)
    if loaded.spec.action.kind == "motors":
        raise PolicyError(
            f"{name}: commands motors, but a link carries body rates and thrust; fly a policy with "
            "actions of kind acceleration or ctbr"
        )
    policy_notes = notes_of(loaded)
    # Some policies compute blocks of 64 rows (drones) at once, so that rounding does not depend on
    # the number of drones. The judge needs that; one vehicle needs one row only.
    flying = for_one_row(loaded) if isinstance(loaded, BlockPolicy) else loaded
    if evaluation.monitor:
        loaded, flying = Monitored(loaded), Monitored(flying)
    settings = LinkFlights(
        evaluation, policy_record(name, loaded, content), limits, link or "simulated"
    )
    refuse_other_run(out, settings)
    if (out / FLY).is_file() or any(out.glob("*.parquet")):
        raise ValueError(
            f"--out {out} holds earlier flights, which are not continued; give another --out"
        )
    show_notes(console, evaluation.simulator, trial_set, [loaded.spec])
    for note in policy_notes:
        console.note(str(note))
    rules = Rules(time_limit_s=evaluation.time_limit_s)
    # The judge's trials come before the flights, since the judge may refuse the policy.
    judged = (
        [] if link else [result.success for result in fly_trials(loaded, evaluation, trial_set)]
    )
    out.mkdir(parents=True, exist_ok=True)
    stopped = None
    if link:
        results = _fly_real_vehicle(flying, trial_set, link, limits, out, console, key)
    else:
        flights: list[Flight] = []
        try:
            for flight in fly_simulated(flying, trial_set, rules, limits, out, console):
                flights.append(flight)
        except (KeyboardInterrupt, WorkFailed) as error:
            stopped = error
        results = {**totals(flights, limits), "judge_successes": sum(judged[: len(flights)])}
        results["flights"] = [flight.row for flight in flights]
        _show_results(results, flights, console)
    if isinstance(flying, Monitored):
        results["interventions"] = flying.interventions
    inputs = {"policy": settings.policy, "limits": limits, "link": settings.link}
    answer = {**stamp(1, evaluation.seed), **inputs, **results}
    write_json(out / FLY, answer)
    write_run_record(out, settings, evaluation.seed)
    if stopped is not None:
        raise stopped
    return {**answer, "out": str(out)}


def _fly_real_vehicle(
    policy: Policy,
    trial_set: TrialSet,
    address: str,
    limits: Limits,
    out: Path,
    console: Console,
    key: bytes | None,
) -> dict[str, Any]:
    """Fly one flight with the vehicle at `address`, and return its results for fly.json."""
    if len(trial_set.trials) != 1:
        raise ValueError(
            f"--link flies one flight, and these options give {len(trial_set.trials)}; give one "
            "track, one level and --trials 1"
        )
    (trial,) = trial_set.trials
    warm_up(policy)
    wire = Wire(COMPANION, VEHICLE, key)
    link = UdpLink(address, wire.is_from_peer)
    track = track_of(trial_set.tracks, trial)
    companion = Companion(policy, track, trial_set.vehicle, wire, time.monotonic, limits)
    vehicle = trial_set.vehicle
    console.say(
        f"vehicle {vehicle.name}: full thrust per mass is {vehicle.full_thrust:.3g} m/s^2; track "
        f"{trial.track}; messages are "
        + ("signed" if key else "not signed: whoever reaches the link can steer the vehicle")
    )
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
        answers = companion.outputs.columns(0)
        row = {**trial._asdict(), **answers, "handed_over": companion.over}
        file = write_log(companion, row, out, console)
    if not companion.rows:
        reason = f"no vehicle sent a state (ODOMETRY) and a depth image within {WAIT_S:g} s"
        if companion.over is not None:
            reason = f"handed over before the first set point: {companion.over}"
        elif companion.wrong_image_size:
            reason += f" ({companion.wrong_image_size})"
        elif ignored := link.strangers + wire.foreign + wire.broken:
            reason += (
                f" ({ignored} messages were ignored: damaged, not of MAVLink system {VEHICLE}, or "
                "not signed with the key of --signing-key)"
            )
        raise WorkFailed(f"{address}: {reason}; see docs/fly.md, 'When it hands over'")
    console.say(f"handed over: {companion.over}; log: {file or 'none'}")
    if link.strangers:
        console.note(f"{link.strangers} datagrams from other senders were ignored")
    answer = {
        **delays(companion.rows, limits.deadline_s),
        "late_answers": row["late_actions"],
        "missed_decisions": companion.missed_decisions,
        "repeated_images": companion.repeated_images,
        "gates_passed": companion.gate,
        "success": companion.over == FINISHED,
        "strangers": link.strangers,
        "flights": [{**row, "file": file}],
    }
    _warn_of_rates(answer, console)
    return answer


def _show_results(results: dict[str, Any], flights: list[Flight], console: Console) -> None:
    """Print the delays as a table, the number of successes, and the reasons of handovers."""
    headers = ("delay", "median [ms]", "p99 [ms]", "longest [ms]")
    names = {
        "answer_ms": "state's arrival to set point",
        "decision_ms": "the same where the policy decided",
        "state_age_ms": "state's stamp to set point",
        "image_age_ms": "image's arrival to decision",
    }
    lines = [
        [text, *(f"{results[key][part]:.2f}" for part in ("median", "p99", "max"))]
        for key, text in names.items()
        if key in results
    ]
    if lines:
        console.show(rich_table(table(headers, lines)))
    count, judged = results["trials"], results["judge_successes"]
    console.say(f"{results['successes']} of {count} finished; without the link: {judged}")
    for flight in flights:
        if flight.row["handed_over"]:
            console.say(f"seed {flight.row['seed']}: handed over: {flight.row['handed_over']}")
    if results["vehicle_slips"]:
        console.note(
            f"warning: the simulated vehicle was late {results['vehicle_slips']} times; run again "
            "on a machine without other load"
        )
    _warn_of_rates(results, console)


def _warn_of_rates(results: dict[str, Any], console: Console) -> None:
    """Print warnings with the probable reasons, if decisions were missed or lacked a new image."""
    if count := results["missed_decisions"]:
        console.note(
            f"warning: {count} decisions were missed: no state arrived in time (send ODOMETRY "
            "several times as often as the policy decides), or the policy took longer than one "
            "decision period"
        )
    count, decisions = results["repeated_images"], results.get("decisions", 0)
    if count > REPEATED_SHARE * decisions:
        console.note(
            f"warning: {count} of {decisions} decisions had no new depth image: send one for each "
            "decision of the policy (if packets are lost, over a better link)"
        )
