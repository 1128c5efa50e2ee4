"""Settings of an import of a flight log: files, units and corrections (`suite import`)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from eval.logs.faults.reading import Readings
from eval.vehicles.vehicle import Vehicle


@dataclass(frozen=True)
class ImportOptions:
    """How to read a log; the defaults fit most files."""

    pose: Path | None = None
    """A CSV or Parquet file with position and attitude from elsewhere (motion capture)."""
    pose_map: Path | None = None
    """Mapping file (TOML) of `pose`; without it, its columns are named as in a flight log."""
    map: Path | None = None
    """Mapping file (TOML), or a shipped one's name: columns, units and frames of a table or of a
    Crazyflie's log; topics of an MCAP file."""
    vehicle: Vehicle | None = None
    """The vehicle file: order of the motors, mass, and thrust at full throttle."""
    full_thrust: float | None = None
    """Thrust per mass at full throttle [m/s^2]; overrides the vehicle's."""
    motor_poles: int | None = None
    """Magnets on a motor's bell, to turn Betaflight's eRPM into revolutions; None: the number in
    the log's header, or 14."""
    rate_hz: float = 250.0
    """At most this many rows a second; faster signals are smoothed over a row's period."""
    start_s: float = 0.0
    """Leave out rows before this time, counted from the file's first sample [s]."""
    end_s: float | None = None
    """Leave out rows after this time, counted from the file's first sample [s]."""
    source: str = ""
    """`mocap` or `estimate` where a file holds both poses; empty: the mapping's order."""
    mass: float | None = None
    """Nominal mass [kg], to divide a thrust in N by; overrides the vehicle's."""
    trim: bool = True
    """Leave out the time on the ground before take-off and after landing."""
    partial: bool = False
    """Accept a log without position, attitude, rates or commands."""
    read: Readings = ()
    """Conversions of signals before any check, see `eval.logs.faults.reading`."""
    fix: bool = True
    """Correct faults with overwhelming evidence; False: only report them."""
