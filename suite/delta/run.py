"""From flight logs to a Delta Action checkpoint with its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from eval.logs.flight_log import FlightLog, read_flights
from policies.formats.delta_file import save_delta
from suite.common.console import Console
from suite.common.estimate import Estimate, announce
from suite.common.provenance import write_run_record
from suite.delta.corrected import corrected
from suite.delta.fit import Errors, Fit, FitConfig, Network, fit, fit_network
from suite.delta.windows import cut_windows
from suite.train.config import PointMassConfig, QuadrotorConfig
from tracks.common.files import plain, write_json, write_text

PLANT_STEPS_S, POINT_STEPS_S = 4e5, 1.5e5
"""Steps of the quadrotor and of the point mass a second that a fit makes, for the estimate."""


def fitting_estimate(config: FitConfig, steps: float, through_quadrotor: bool) -> Estimate:
    """Return about how long a fit takes with windows of `steps`, and what memory it needs."""
    work = config.iterations * config.batch * steps
    if through_quadrotor:
        return Estimate(40 + work / PLANT_STEPS_S, 1.5e9)
    return Estimate(20 + work / POINT_STEPS_S, 8e8)


def flight_files(paths: Sequence[Path]) -> list[Path]:
    """Return the flight logs among `paths`, folders standing for the logs in them.

    Raises:
        ValueError: where there is none.
    """
    files = []
    for path in paths:
        inside = [*path.glob("*.parquet"), *path.glob("*.csv")] if path.is_dir() else [path]
        files += sorted(inside)
    if not files:
        where = ", ".join(map(str, paths)) or "nowhere"
        raise ValueError(f"no flight logs in {where}; record some with suite collect")
    return files


def split(
    logs: Sequence[FlightLog], share: float, seed: int
) -> tuple[list[FlightLog], list[FlightLog]]:
    """Return (flights to fit, held-out flights), at least one of each.

    Raises:
        ValueError: where there are fewer than two flights or the share is not within (0, 1).
    """
    if not 0.0 < share < 1.0:
        raise ValueError(f"held_out is {share}, allowed is more than 0 and less than 1")
    if len(logs) < 2:
        raise ValueError(f"{len(logs)} flight given, at least 2 are needed: one is held out")
    order = np.random.default_rng(seed).permutation(len(logs))
    count = min(len(logs) - 1, max(1, round(share * len(logs))))
    held = {int(i) for i in order[:count]}
    return (
        [log for i, log in enumerate(logs) if i not in held],
        [log for i, log in enumerate(logs) if i in held],
    )


def fit_delta(
    config: FitConfig, physics: PointMassConfig, paths: Sequence[Path], out: Path, console: Console
) -> Fit:
    """Fit the Delta Action Model to flight logs; write the checkpoint, the curve and the table.

    Raises:
        ValueError: where the logs cannot be used.
    """
    known, held = _read(config, paths, console)
    windows = cut_windows(known, config.horizon_s, config.stride_s)
    held_windows = cut_windows(held, config.horizon_s, config.stride_s)
    needs = fitting_estimate(config, windows.action_b.shape[1], False)
    announce(console, "fitting the Delta Action Model", needs)
    with console.progress("fitting", config.iterations) as show:
        result = fit(config, physics, windows, held_windows, show)
    summary = {
        "windows": {"fit": len(windows.acc_w), "held_out": len(held_windows.acc_w)},
        "point_mass": result.point_mass,
        "fitted_point_mass": result.fitted_point_mass,
        "delta_action": result.delta_action,
        "identified": result.identified,
        "curve": result.curve,
    }
    words = table(result, config.horizon_s)
    _write(config, corrected(physics), held, result.params, summary, words, out)
    return result


def fit_quadrotor_delta(
    config: FitConfig, quad: QuadrotorConfig, paths: Sequence[Path], out: Path, console: Console
) -> Network:
    """Fit a Delta Action Model of the trainer's quadrotor; write the same files.

    Raises:
        ValueError: where the logs cannot be used.
    """
    from suite.delta.quadrotor import cut_quadrotor_windows, replay_quadrotor

    known, held = _read(config, paths, console)
    windows, cut = cut_quadrotor_windows(known, quad, config.horizon_s, config.stride_s)
    held_windows, _ = cut_quadrotor_windows(held, quad, config.horizon_s, config.stride_s)
    needs = fitting_estimate(config, windows.action_b.shape[1] * cut.physics, True)
    announce(console, "fitting the Delta Action Model through the quadrotor", needs)
    with console.progress("fitting", config.iterations) as show:
        replay = partial(replay_quadrotor, quad, cut)
        result = fit_network(config, replay, windows, held_windows, show)
    summary = {
        "vehicle": quad.vehicle,
        "windows": {"fit": len(windows.start_s), "held_out": len(held_windows.start_s)},
        "without": result.without,
        "delta_action": result.with_delta,
        "curve": result.curve,
    }
    words = quadrotor_table(result, config.horizon_s)
    _write(config, corrected(quad), held, result.params, summary, words, out)
    return result


def _read(
    config: FitConfig, paths: Sequence[Path], console: Console
) -> tuple[list[FlightLog], list[FlightLog]]:
    logs, warnings = read_flights(flight_files(paths))
    for warning in warnings:
        console.note(f"warning: {warning}")
    return split(logs, config.held_out, config.seed)


def _write(
    config: FitConfig,
    of: Mapping[str, Any],
    held: Sequence[FlightLog],
    params: Mapping[str, Any],
    summary: Mapping[str, Any],
    words: str,
    out: Path,
) -> None:
    write_run_record(out, config, config.seed)
    names = [log.name for log in held]
    about = {"model": of["model"], "horizon_s": config.horizon_s, "held_out": names, **summary}
    save_delta(out / "delta", params, seed=config.seed, fit={**plain(config), **of})
    write_json(out / "delta.json", plain(about))
    write_text(out / "table.md", words)


def quadrotor_table(result: Network, horizon_s: float) -> str:
    """Return the held-out errors through the quadrotor as a Markdown table."""
    rows = (
        ("quadrotor of the vehicle file", result.without),
        ("quadrotor with Delta Action Model", result.with_delta),
    )
    return _markdown(rows, horizon_s, "the quadrotor's")


def table(result: Fit, horizon_s: float) -> str:
    """Return the held-out errors as a Markdown table."""
    rows = (
        ("point mass as trained in", result.point_mass),
        ("point mass, lag, drag and delay fitted", result.fitted_point_mass),
        ("point mass with Delta Action Model", result.delta_action),
    )
    return _markdown(rows, horizon_s, "the point mass's")


def _markdown(rows: Sequence[tuple[str, Errors]], horizon_s: float, whose: str) -> str:
    base = rows[0][1].position_m
    lines = [
        f"| held-out flights, after {horizon_s:g} s | position error [m] "
        f"| velocity error [m/s] | of {whose} |",
        "|---|---|---|---|",
    ]
    for name, errors in rows:
        share = errors.position_m / base
        lines.append(
            f"| {name} | {errors.position_m:.3f} | {errors.velocity_m_s:.3f} | {share:.2f} |"
        )
    return "\n".join([*lines, ""])
