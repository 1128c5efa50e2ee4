"""Raw Blackbox logs (`.bbl`, `.bfl`), decoded by betaflight-chirp-core (Apache-2.0).

The result has the columns that `blackbox_decode` prints, by the same names, in the units that the
log's own header says (Betaflight's blackbox documentation): deg/s (a tenth of the number under
`blackbox_high_resolution`), counts of `acc_1G`, hundredths of a volt (from Betaflight 4 on), eRPM
in hundreds, and motor outputs between the two numbers of `motorOutput`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eval.logs.columns import FlightLogError, quoted
from eval.logs.faults.finding import Finding

MARKER = b"H Product:Blackbox"
ACC_1G = 2048.0
"""Raw counts of accSmooth per g, on all boards of Betaflight 4."""
MISSING = (
    "a raw Blackbox log; pip install 'diffracing-suite[blackbox]' reads it, or decode it with "
    "blackbox_decode and import the CSV"
)


class Decoded(NamedTuple):
    """One log of a raw file."""

    columns: dict[str, np.ndarray]
    """As `blackbox_decode` names them, the unit in brackets behind where it is not the usual."""
    header: dict[str, Any]
    """The settings in the log's header."""
    findings: tuple[Finding, ...]


def decode(path: Path) -> Decoded:
    """Return the longest log of the raw file at `path`.

    Raises:
        FlightLogError: where the decoder is not installed, or nothing can be decoded.
    """
    try:
        from betaflight_chirp_core import decoder
    except ImportError:
        raise FlightLogError(str(path), None, None, MISSING) from None
    raw = path.read_bytes()
    try:
        return _longest(decoder, raw)
    except Exception as error:  # whatever a damaged file makes of the decoder
        reason = f"a Blackbox log that cannot be decoded ({quoted(error)})"
        raise FlightLogError(str(path), None, None, reason) from None


def _longest(decoder: Any, raw: bytes) -> Decoded:
    """Return the longest log of a file's bytes; damaged ones raise what they make the decoder."""
    parts = decoder.split_sessions(raw)
    number, (start, end) = max(enumerate(parts, start=1), key=lambda p: p[1][1] - p[1][0])
    parser = decoder.FlightLogParser(raw, start, end)
    parser.parse_header()
    parser.parse_data()
    if not parser.main_frames:
        raise ValueError("it has no frame; log again")
    findings = []
    if len(parts) > 1:
        text = f"holds {len(parts)} logs; the longest, number {number}, is read"
        findings.append(Finding("note", "file", text))
    damaged = int(parser.stats["total_corrupt_frames"])
    if damaged:
        text = f"{damaged} frames are damaged (a slow memory card?) and left out"
        findings.append(Finding("note", "file", text))
    table = np.array(parser.main_frames, dtype=np.float64).T
    columns = dict(zip(parser.main_field_names, table, strict=True))
    return Decoded(_in_units(columns, parser.sys_config), parser.sys_config, tuple(findings))


def _in_units(columns: dict[str, np.ndarray], header: dict[str, Any]) -> dict[str, np.ndarray]:
    fine = 10.0 if header.get("blackbox_high_resolution") == 1 else 1.0
    out = {}
    for name, value in columns.items():
        stem = name.partition("[")[0]
        if stem in ("gyroADC", "gyroUnfilt") or (stem == "setpoint" and name != "setpoint[3]"):
            out[name] = value / fine
        elif stem == "accSmooth":
            per_g = header.get("acc_1G")
            out[f"{name} (g)"] = value / (
                per_g if isinstance(per_g, (int, float)) and per_g > 0 else ACC_1G
            )
        else:
            out[name] = value
    return out
