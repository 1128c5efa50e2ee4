"""From flight logs to a Delta Action checkpoint with its report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eval.flight_log import FlightLog, read_flights
from policies.delta_file import save_delta
from suite.console import Console
from suite.delta.fit import Errors, Fit, FitConfig, fit
from suite.delta.windows import cut_windows
from suite.estimate import Estimate, announce
from suite.provenance import write_run_record
from suite.train.config import PointMassConfig
from tracks.files import plain, write_json, write_text


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
    logs, warnings = read_flights(flight_files(paths))
    for warning in warnings:
        console.note(f"warning: {warning}")
    known, held = split(logs, config.held_out, config.seed)
    windows = cut_windows(known, config.horizon_s, config.stride_s)
    held_windows = cut_windows(held, config.horizon_s, config.stride_s)
    work = config.iterations * config.batch * windows.action_b.shape[1]
    announce(console, "fitting the Delta Action Model", Estimate(20 + work / 1.5e5, 8e8))
    with console.progress("fitting", config.iterations) as show:
        result = fit(config, physics, windows, held_windows, show)
    held_out = [log.name for log in held]
    write_run_record(out, config, config.seed)
    summary = {
        "horizon_s": config.horizon_s,
        "held_out": held_out,
        "windows": {"fit": len(windows.acc_w), "held_out": len(held_windows.acc_w)},
        "point_mass": result.point_mass,
        "fitted_point_mass": result.fitted_point_mass,
        "delta_action": result.delta_action,
        "identified": result.identified,
        "curve": result.curve,
    }
    save_delta(out / "delta", result.params, seed=config.seed, fit=plain(config))
    write_json(out / "delta.json", plain(summary))
    write_text(out / "table.md", table(result, config.horizon_s))
    return result


def table(result: Fit, horizon_s: float) -> str:
    """Return the held-out errors as a Markdown table."""
    base = result.point_mass.position_m

    def row(name: str, errors: Errors) -> str:
        share = errors.position_m / base
        return f"| {name} | {errors.position_m:.3f} | {errors.velocity_m_s:.3f} | {share:.2f} |"

    return "\n".join(
        [
            f"| held-out flights, after {horizon_s:g} s | position error [m] "
            "| velocity error [m/s] | of the point mass's |",
            "|---|---|---|---|",
            row("point mass as trained in", result.point_mass),
            row("point mass, lag, drag and delay fitted", result.fitted_point_mass),
            row("point mass with Delta Action Model", result.delta_action),
            "",
        ]
    )
