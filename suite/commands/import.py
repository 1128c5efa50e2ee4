"""The command `suite import`: convert a log of another program to a flight log, and check it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from suite.common.console import Console, counted
from suite.common.options import Advanced, Command
from tracks.common.files import check_no_input, check_place
from tracks.input.ranges import Range


@dataclass(frozen=True)
class Config(Command):
    """Read and check a log of PX4, ArduPilot, Betaflight, a Crazyflie, ROS 2 or a table."""

    file: tyro.conf.Positional[Path]
    """The log to read."""
    format: str = ""
    """px4, betaflight, ardupilot, crazyflie, table or mcap. Without it the file's first bytes
    decide."""
    out: Path = Path("flight.parquet")
    """The flight log to write (.parquet or .csv)."""
    map: Path | None = None
    """Columns, units and frames of a table or a Crazyflie's log, or topics of an MCAP file: a
    mapping file (TOML), or nanobench, crazypad, crazyswarm2 or crazyflie."""
    source: Advanced[Literal["mocap", "estimate"] | None] = None
    """For a file with raw motion capture and an estimate: take the pose from this one. Without it
    in the mapping's order."""
    pose: Path | None = None
    """CSV or Parquet file with position and attitude from another source, such as motion capture;
    its clock is aligned with the log's."""
    pose_map: Advanced[Path | None] = None
    """Mapping file (TOML) of --pose."""
    vehicle: str = ""
    """A shipped vehicle's name or a vehicle file, for the order of the motors and the full
    thrust."""
    full_thrust: Annotated[float, Range(0.0, 1000.0, above=True, below=True)] | None = None
    """Thrust per mass at full throttle [m/s^2], for a log with normalised thrust. Without it that
    of --vehicle."""
    mass: Annotated[float, Range(0.0, 10_000.0, above=True)] | None = None
    """Nominal mass [kg], for a log with thrust in N. Without it that of --vehicle."""
    motor_poles: Advanced[Annotated[int, Range(2, 1000)] | None] = None
    """Number of magnets in a motor, for Betaflight's eRPM. Without it that of the log, or 14."""
    rate: Advanced[Annotated[float, Range(5.0, 10_000.0)]] = 250.0
    """Largest number of rows per second."""
    start: Advanced[Annotated[float, Range(0.0, 1e9)]] = 0.0
    """Leave out earlier samples [s after the file's first sample]."""
    end: Advanced[Annotated[float, Range(0.0, 1e9)] | None] = None
    """Leave out rows after this time [s after the file's first sample]. Without it none."""
    keep_ground: Advanced[bool] = False
    """Keep the time before take-off and after landing."""
    partial: bool = False
    """Accept a log without position, attitude, rates or commands, and keep all other signals."""
    read: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Read a signal differently, as suite check prints it as a fix: rate=x,-y,-z+0.0610352,
    quat=xyzw, time=ms or motor=2,1,4,3; may be given several times."""
    no_fix: Advanced[bool] = False
    """Print probable faults, but correct none."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Convert the log, and print the findings (records of probable faults)."""
    import numpy as np

    from eval.importers import import_log
    from eval.importers.options import ImportOptions
    from eval.logs.faults.finding import finding_lines
    from eval.logs.faults.reading import parse_readings
    from eval.logs.flight_log import columns_from_log, write_flight
    from eval.quadrotor.vehicle_file import load_vehicle

    _check(config)
    options = ImportOptions(
        pose=config.pose,
        pose_map=config.pose_map,
        map=config.map,
        vehicle=load_vehicle(config.vehicle) if config.vehicle else None,
        full_thrust=config.full_thrust,
        motor_poles=config.motor_poles,
        rate_hz=config.rate,
        start_s=config.start,
        end_s=config.end,
        source=config.source or "",
        mass=config.mass,
        trim=not config.keep_ground,
        partial=config.partial,
        read=parse_readings(config.read),
        fix=not config.no_fix,
    )
    log, findings = import_log(config.file, config.format or None, options)
    write_flight(config.out, log)
    for line in finding_lines(findings):
        console.say(line)
    for warning in log.warnings:
        console.say(f"note      file: {warning}")
    rows, has_speed = len(log.time_s), np.isfinite(log.speed).any()
    speed_text = f"up to {np.nanmax(log.speed):.1f} m/s" if has_speed else "no speed"
    console.say(f"{counted(rows, 'row')}, {log.duration_s:.1f} s, {speed_text}: {config.out}")
    return {
        "flight": str(config.out),
        "rows": rows,
        "duration_s": log.duration_s,
        "columns": sorted(columns_from_log(log)),
        "partial": list(log.partial),
        "findings": [finding._asdict() for finding in findings],
    }


def _check(config: Config) -> None:
    """Refuse options that contradict each other, and an output that would replace an input."""
    if config.out.suffix.lower() not in (".parquet", ".csv"):
        raise ValueError(f"--out is {str(config.out)!r}; its ending must be .parquet or .csv")
    if config.end is not None and config.end <= config.start:
        raise ValueError(f"--start {config.start:g} --end {config.end}: 0 <= start < end, in s")
    if (config.motor_poles or 0) % 2:
        raise ValueError(f"--motor-poles {config.motor_poles}: the number of magnets is even")
    if config.pose_map is not None and config.pose is None:
        raise ValueError("--pose-map describes the file of --pose, which is not given")
    check_no_input(config.out, [config.file, config.pose])
    check_place(config.out)
