"""Builds the folded sections of a diagnosis report, from its logs to its evidence.

Each function returns one section, from the diagnosis or from its JSON (`result`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eval.logs.flight_log import FlightLog
from suite.common.report import Part, Section
from suite.diagnose.data.sampling import on_every_row, own_spacing_s
from suite.diagnose.data.windows import SLICES, UNITS
from suite.diagnose.diagnose import Diagnosis
from suite.diagnose.report.summary import figure, remaining_words, short_name, superscripts
from suite.diagnose.sources.rollout_source import of_rollouts
from tracks.common.grid import Cell, Grid, table, table_of

SHOWN = 12
"""Largest number of logs in the table of logs."""
LEAST_P = 0.0005
"""P-values up to this are not printed, as some thousand draws do not resolve them."""
ALONE = (
    "All {count} candidates, each fitted alone before anything was named. The gain is the fall of "
    "the whitened squared error on stretches that were left out of its fit."
)
CHANGED = (
    "The candidates whose gain is close to the best, each fitted alone before anything was named. "
    "The gain is the fall of the whitened squared error of the flights' means, less two for each "
    "fitted number."
)
"""Explanations of the table of candidates; the second is for a change since reference flights."""


def logs_section(logs: Sequence[FlightLog]) -> Section:
    """Return a table of the logs."""
    headers = ["log", "lasts", "rows", "rate", "longest step", "incomplete", "top speed", "others"]
    others = len(logs) - SHOWN
    note = f"And {others} more." if others > 0 else ""
    return Section("The logs", [table(headers, map(_facts, logs[:SHOWN]), note=note)])


def _facts(log: FlightLog) -> tuple[str, ...]:
    """Return the table row of a log, with the share of its rows that lie in a hole of a signal."""
    optional = {
        "commands": log.thrust_cmd is not None,
        "velocity": not log.velocity_derived,
        "rotor speeds": log.rotor_speed is not None,
        "rotor commands": log.rotor_speed_cmd is not None,
        "accelerometer": log.acc_b is not None,
        "voltage": log.voltage is not None,
    }
    steps, speed = np.diff(log.time_s), log.speed[np.isfinite(log.speed)]
    return (
        short_name(log.name),
        f"{log.duration_s:.1f} s",
        f"{len(log.time_s)}",
        f"{1.0 / own_spacing_s(log.time_s, log.rate_b):.0f} Hz",
        f"{1e3 * float(steps.max()):.0f} ms",
        f"{100 * float(1.0 - on_every_row(log).whole.mean()):.1f} %",
        f"{speed.max():.1f} m/s" if len(speed) else "",
        ", ".join(name for name, is_logged in optional.items() if is_logged) or "none",
    )


def noise_section(diagnosis: Diagnosis) -> Section:
    """Return a table of the measurement noise of every channel."""
    sigma = of_rollouts(diagnosis.main.search.last).noise.sigma
    rows = [
        (f"{name} [{UNITS[name]}]", ", ".join(f"{v:.3g}" for v in values))
        for name, place in SLICES.items()
        if np.isfinite(values := sigma[place]).any()
    ]
    words = (
        "Standard deviation by axis, estimated from measured minus simulated values without their "
        "slow part. Squared errors below are in units of it. If the gap does not exceed that of "
        "the noise, the verdict is no_gap."
    )
    return Section("The measurement noise", [words, table(["measured", "noise"], rows)])


def actuators_section(result: Mapping[str, Any]) -> Section:
    """Return a section that compares measured and commanded rotor speeds."""
    words = (
        f"The input of the model is {result['driven_by']}. The flight controller and the motors "
        "cause the difference between commanded and measured rotor speeds, not the air. It shows "
        "integrators and filters that the nominal rate loop lacks."
    )
    grids = [_mismatch(mismatch) for mismatch in result["actuators"]]
    return Section("Actuators, apart from the air", [words, *grids])


def _mismatch(mismatch: Mapping[str, Any]) -> Grid:
    """Return a table that compares measured rotor speeds with one kind of command."""

    def spread(pair: Sequence[float]) -> str:
        return f"{pair[0]:.2f} ± {pair[1]:.2f}"

    explained = f"{100 * max(mismatch['followed'], 0.0):.0f} % of the variance is explained"
    turn = ", ".join(map(spread, mismatch["turn"]))
    rows = [
        ("standard deviation of the speeds", f"{mismatch['spread']:.1f} rad/s"),
        ("difference, with the file's lag and delay", f"{mismatch['rms']:.1f} rad/s ({explained})"),
        ("lag that fits best", f"{1e3 * mismatch['time_constant']:.1f} ms"),
        ("delay before it", f"{1e3 * mismatch['delay']:.1f} ms"),
        ("measured over commanded, by rotor", ", ".join(f"{s:.4f}" for s in mismatch["scale"])),
        ("difference with these", f"{mismatch['rms_fitted']:.1f} rad/s"),
        ("excess thrust", f"{spread(mismatch['thrust'])} m/s²"),
        ("excess angular acceleration, x y z", f"{turn} rad/s²"),
    ]
    note = "± is the standard deviation over the rows of the logs."
    return table(["", ""], rows, f"Compared with the {mismatch['commanded_by']}", note)


def candidates_section(diagnosis: Diagnosis) -> Section:
    """Return the gain of each candidate when it is fitted alone, for each source of evidence."""
    parts: list[Part] = []
    for finding in diagnosis.findings:
        scores = finding.search.first
        if not scores:
            continue
        named = {candidate.label for candidate in finding.search.candidates}
        rows = [
            (
                s.candidate.label,
                f"{s.gain:.1f}",
                f"{s.p_value:.4f}" if s.p_value > LEAST_P else "",
                "named" if s.candidate.label in named else "",
            )
            for s in scores
        ]
        words = CHANGED if diagnosis.flights.references else ALONE.format(count=len(scores))
        words += (
            f" P is the probability that the best of all candidates gains as much by chance, left "
            f"out up to {LEAST_P:g}. Effects are named one after another while p is at most "
            f"{finding.search.judged.evidence.limits.name_p_value:g}; then all are refitted "
            "jointly."
        )
        if scores[0].chance > 0.0:
            best = scores[0]
            words += f" For {best.candidate.label}, a gain of {best.chance:.1f} has p = 0.01."
        title = finding.source.name.capitalize()
        parts.append(table(["effect", "gain", "p", ""], rows, title, words))
    return Section("The candidates", parts)


def rivals_section(diagnosis: Diagnosis, result: Mapping[str, Any]) -> Section:
    """Return a table of other effects that were fitted in place of each named one."""
    rows = []
    for finding, named in diagnosis.named:
        ordered = sorted(named.worse_by.items(), key=lambda item: item[1])
        for label, worse_by in ordered[:6]:
            name = label.rstrip(" 1234")  # a label may end in a motor's number
            # Another motor is no other effect, so it is not among the rivals.
            is_motor = name == named.candidate.name
            fits_as_well = is_motor and worse_by <= finding.source.limits.rival_chi2
            is_open = fits_as_well or name in named.rivals
            verdict = Cell("not separable", "bad") if is_open else "ruled out"
            rows.append((named.candidate.label, label, f"{worse_by:.1f}", verdict))
    headers = ["named", "alternative", "worse by", ""]
    note = (
        "Worse by: squared error in units of the noise, plus one for each fitted parameter; 9 is "
        "three standard errors. Effects without a row were too far off to be fitted."
    )
    parts: list[Part] = [table(headers, rows, note=note)] if rows else []
    if not diagnosis.named:
        parts.append("Nothing was named, so there are no alternatives.")
    elif not result["separate_with"]:
        parts.append("No other effect explains the same flights as well.")
    return Section("Alternatives to the named effects", parts)


def residual_section(result: Mapping[str, Any]) -> Section:
    """Return the error that remains with the named effects, and its structure."""
    remaining = result["unexplained"]
    words = "No structure beyond the measurement noise remains."
    if remaining["above_noise"]:
        words = f"Above the noise floor remains {remaining_words(result)}."
    if remaining["where"]:
        share, where = 100 * remaining["share"], superscripts(remaining["where"])
        of = f"{result['gap']['of']} above the noise floor"
        words = f"{share:.0f} % of the {of} remains. Unexplained: {where}."
    parts: list[Part] = [words]
    if remaining["above_noise"]:
        columns = (
            ("view", lambda one: one["view"]),
            ("remaining error", lambda one: superscripts(f"{one['error']:.3g} {one['unit']}")),
            ("noise floor", lambda one: f"{one['noise_floor']:.3g}"),
            ("", lambda one: f"an error {one['reason']}"),
        )
        title = "Errors above the noise floor"
        note = (
            "The noise floor of force and torque contains the noise of the measured motion, but no "
            "errors of rotor speeds or attitude. Such errors may cause what logged signals hardly "
            "predict."
        )
        parts.append(table_of(remaining["above_noise"], *columns, title=title, note=note))
    if remaining.get("shapes"):
        shapes = remaining["shapes"]
        rows = [(s["label"], f"{s['gain']:.1f}", f"{s['p_value']:.3f}") for s in shapes]
        note = (
            "A force or torque outside the catalogue, as a simple function of the state: its gain "
            "on left-out stretches, and its p-value."
        )
        headers = ["remaining error as a", "gain", "p"]
        parts.append(table(headers, rows, "Functions of the state", note))
        rows = [(axis, f"{p:.2g}") for axis, p in remaining["coloured"].items()]
        note = "P-value: probability that noise alone has as much energy in a smooth disturbance."
        parts.append(table(["axis", "p"], rows, "Random disturbances", note))
    return Section("Remaining error", parts)


def evidence_section(diagnosis: Diagnosis, result: Mapping[str, Any]) -> Section:
    """Return a table of the gaps on held-out flights: as given, named, and with a wrong effect."""
    main = diagnosis.main
    gaps = {"as given": main.before}
    if main.control is not None:
        gaps[f"wrong: {main.control[0]}"] = main.control[1]
    if len(main.without) > 1:
        gaps |= {f"without {label}": gap for label, gap in main.without.items()}
    if main.names:
        gaps["with the named effects"] = main.after
    before, floor, rows = main.before.rms, main.before.floor, []
    for label, gap in gaps.items():
        interval, removed = " to ".join(map(figure, gap.ci95(diagnosis.seed) or ())), ""
        if gap.rms != before and before > floor:
            removed = f"{min(100 * (before - gap.rms) / (before - floor), 100.0):.0f} %"
        rows.append((label, figure(gap.rms), interval, removed))
    words = (
        f"{superscripts(main.source.measure)}. Held out of search and fits: "
        f"{', '.join(result['gap']['held_out'])}. The noise floor is {floor:.3g}."
    )
    note = (
        "95 %: bootstrap over blocks of neighbouring stretches. Wrong: the best effect that is "
        "neither named nor an alternative, fitted to the same flights in the same way."
    )
    headers = ["vehicle", "gap", "95 %", "of the gap removed"]
    return Section("The evidence", [words, table(headers, rows, note=note)])


def agreement_section(diagnosis: Diagnosis) -> Section:
    """Return what each source compares, and how much each flight supports the named effects."""
    parts: list[Part] = [
        f"{finding.source.name}: {finding.source.about}, in {finding.source.window}; "
        f"driven by {diagnosis.flights.driven_by}."
        for finding in diagnosis.findings
    ]
    note = (
        "The fall of the squared error of each flight (of a single flight: of each third) with "
        "parameters that were fitted to the others, in units of independent noise. If force and "
        "torque are compared, or if no effect explains the whole error, an effect is named only if "
        "all flights but one agree."
    )
    for finding, named in diagnosis.named:
        if named.gains:
            rows = [(f"{k + 1}", f"{gain:.1f}") for k, gain in enumerate(named.gains)]
            title = f"{finding.source.name}: {named.candidate.label}"
            parts.append(table(["fitted flight or third", "gain"], rows, title, note))
    if diagnosis.flights.compares:
        parts.append(diagnosis.flights.compares)
    return Section("Do the flights agree", parts)
