"""Fit a Delta Action Model to flight logs, and write its checkpoint and tables (`suite delta`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from eval.logs.faults.checked import CheckedFlights
from eval.logs.flight_log import FlightLog
from policies.formats.checkpoint import save_arrays
from policies.formats.policy_file import DELTA
from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.common.provenance import refuse_other_run, write_run_record
from suite.common.stages import Estimate, announce, refuse_other_options
from suite.delta.fit import DeltaFit, FitConfig, fit_network, fit_point_mass
from suite.delta.replay import QUAD, describe_dynamics
from suite.delta.windows import cut_windows, decision_rate, on_state_rows
from suite.train.config import PointMassConfig, QuadrotorConfig
from tracks.common.files import plain, write_json, write_text
from tracks.common.grid import Grid, markdown, table_of
from tracks.common.provenance import stamp, stamp_text

SCHEMA = 1
"""Version of delta.json."""
PLANT_STEPS_S, POINT_STEPS_S = 4e5, 1.5e5
"""Simulated steps a second of the quadrotor and of the point mass in a fit, from which the duration
of a fit is estimated."""
MODEL_NAMES = {
    "point_mass": "point mass as trained in",
    "without": "quadrotor of the vehicle file",
    "fitted_point_mass": "point mass, lag, drag and delay fitted",
    "delta_action": "{} with Delta Action Model",
}
"""Key in delta.json -> name of a model that replays the held-out flights. The uncorrected dynamics
are first: `point_mass` or, for a quadrotor, `without`. The Delta Action Model, with the name of the
dynamics that it corrects, is last."""


def fitting_estimate(config: FitConfig, steps: float, through_quadrotor: bool) -> Estimate:
    """Return the approximate time and memory of a fit with `steps` simulated steps a window."""
    total = config.iterations * config.batch * steps
    if through_quadrotor:
        return Estimate(40 + total / PLANT_STEPS_S, 1.5e9)
    return Estimate(20 + total / POINT_STEPS_S, 8e8)


def split(
    logs: Sequence[FlightLog], share: float, seed: int
) -> tuple[list[FlightLog], list[FlightLog]]:
    """Return (flights to fit, held-out flights), at least one of each.

    Raises:
        ValueError: for fewer than two flights.
    """
    if len(logs) < 2:
        raise ValueError(f"{len(logs)} flight given, at least 2 are needed: one is held out")
    order = np.random.default_rng(seed).permutation(len(logs))
    count = min(len(logs) - 1, max(1, round(share * len(logs))))
    held_out = {int(i) for i in order[:count]}
    return (
        [log for i, log in enumerate(logs) if i not in held_out],
        [log for i, log in enumerate(logs) if i in held_out],
    )


def long_enough(logs: Sequence[FlightLog], horizon_s: float) -> tuple[list[FlightLog], list[str]]:
    """Return the flights that are long enough for a window, and warnings about the others.

    If fewer than two are long enough, all are returned; cutting them then raises the error.
    """
    # A window begins after the first two decisions.
    needed_s = horizon_s + 2.0 / decision_rate(logs)
    long = [log for log in logs if log.duration_s >= needed_s]
    if len(long) < 2:
        return list(logs), []
    return long, [
        f"{log.name}: left out, it lasts {log.duration_s:.2f} s and a window {horizon_s:g} s"
        for log in logs
        if log.duration_s < needed_s
    ]


def fit_delta(
    config: FitConfig,
    dynamics: PointMassConfig | QuadrotorConfig,
    flights: CheckedFlights,
    out: Path,
    console: Console,
    request: Any = None,
) -> DeltaFit:
    """Fit the Delta Action Model to flight logs; write delta/, delta.json and table.md into `out`.

    It corrects the trainer's point mass or quadrotor, `dynamics`. run.json records `request`, the
    options of the command, or else `config`.

    Raises:
        ValueError: for flights that are too few or too short, or lack a column, and if `out` has a
            fit with other options.
        WorkFailed: if an error on the held-out flights is not finite.
    """
    request = request or config
    refuse_other_run(out, request)
    refuse_other_options(out, request)
    # Hold some of the flights out.
    logs, short = long_enough([on_state_rows(log) for log in flights.logs], config.horizon_s)

    def warn(text: str) -> None:
        console.note(f"warning: {text}")

    for warning in [*flights.warnings, *short]:
        warn(warning)
    groups = split(logs, config.held_out, config.seed)
    description = describe_dynamics(dynamics)
    # Cut both groups into windows, and select the fit through the given dynamics.
    run_fit: Callable[[Any, Any, Callable[[int, str], None]], DeltaFit]
    fit_windows: Any
    held_out: Any
    if isinstance(dynamics, QuadrotorConfig):
        from suite.delta.quadrotor import cut_quadrotor_windows, replay_quadrotor, row_period

        row_s = row_period(logs)
        cuts = [
            cut_quadrotor_windows(group, dynamics, config.horizon_s, config.stride_s, row_s, warn)
            for group in groups
        ]
        fit_windows, held_out = (windows for windows, _ in cuts)
        substeps = cuts[0][1]
        title, steps = "fitting the Delta Action Model through the quadrotor", substeps.physics
        run_fit = partial(fit_network, config, partial(replay_quadrotor, dynamics, substeps))
    else:
        fit_windows, held_out = (
            cut_windows(group, config.horizon_s, config.stride_s, warn) for group in groups
        )
        title, steps = "fitting the Delta Action Model", 1
        run_fit = partial(fit_point_mass, config, dynamics)
    # Fit, with progress. `steps` becomes the number of simulated steps in a window.
    rate_hz = decision_rate(logs)
    steps *= fit_windows.action_b.shape[1]
    announce(console, title, fitting_estimate(config, steps, description["model"] == QUAD))
    with console.progress("fitting", config.iterations) as show:
        result = run_fit(fit_windows, held_out, show)  # pyrefly: ignore[bad-argument-type]
    if not np.isfinite(list(result.errors.values())).all():
        raise WorkFailed(
            "the fit diverged: an error on the held-out flights is not finite, so no model is "
            "written; give another --seed, or check the vehicle file and the flights"
        )
    # Write the record, the checkpoint and the tables.
    record = {
        "model": description["model"],
        "horizon_s": config.horizon_s,
        "held_out": [log.name for log in groups[1]],
        **({"vehicle": dynamics.vehicle} if isinstance(dynamics, QuadrotorConfig) else {}),
        "windows": {"fit": len(fit_windows.pos_w), "held_out": len(held_out.pos_w)},
        **result.errors,
        **({} if result.identified is None else {"identified": result.identified}),
        "curve": result.curve,
        "findings": flights.findings,
    }
    write_run_record(out, request, config.seed)
    stored = {**plain(config), **description, "rate_hz": rate_hz}
    save_arrays(out / "delta", result.params, kind=DELTA, seed=config.seed, extra={"fit": stored})
    header = stamp(SCHEMA, config.seed)
    summary = {**header, **plain(record)}
    write_json(out / "delta.json", summary)
    table = markdown(errors_grid(summary))
    write_text(out / "table.md", f"{table}\n<!-- {stamp_text(header)} -->\n")
    return result


def errors_by_name(fitted: Mapping[str, Any]) -> dict[str, Mapping[str, float]]:
    """Return the held-out errors in delta.json by the model's name, as in `MODEL_NAMES`."""
    dynamics = "quadrotor" if "without" in fitted else "point mass"
    return {
        name.format(dynamics): fitted[key] for key, name in MODEL_NAMES.items() if key in fitted
    }


def errors_grid(fitted: Mapping[str, Any], title: str = "") -> Grid:
    """Return a table of the held-out errors; `fitted` are the contents of delta.json."""
    errors = errors_by_name(fitted)
    # The first model is the uncorrected dynamics, with which the others are compared.
    base_m = next(iter(errors.values()))["position_m"]
    return table_of(
        errors.items(),
        (f"held-out flights, after {fitted['horizon_s']:g} s", lambda row: row[0]),
        ("position error [m]", lambda row: f"{row[1]['position_m']:.3f}"),
        ("velocity error [m/s]", lambda row: f"{row[1]['velocity_m_s']:.3f}"),
        ("of the first", lambda row: f"{row[1]['position_m'] / base_m:.2f}"),
        title=title,
    )
