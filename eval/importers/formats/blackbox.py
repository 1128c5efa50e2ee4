"""Decode raw Blackbox logs of Betaflight (`.bbl`, `.bfl`) with betaflight-chirp-core (Apache-2.0).

The result has the same column names as the CSV files of `blackbox_decode`. Units follow the log's
header (Betaflight's Blackbox documentation): rates in deg/s (0.1 deg/s under
`blackbox_high_resolution`, converted here), accelerations in counts (converted to g by `acc_1G`),
voltage in 0.01 V (from Betaflight 4 on), eRPM in hundreds, and motor outputs in the range of
`motorOutput`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from eval.logs.columns import FlightLogError, quoted
from eval.logs.faults.finding import Finding

MARKER = b"H Product:Blackbox"
"""Text that begins the header of each raw log in a file."""
ACC_1G = 2048.0
"""Raw counts of accSmooth per g, on all boards of Betaflight 4."""
MISSING = (
    "a raw Blackbox log; pip install 'diffracing-suite[blackbox]' reads it, or decode it with "
    "blackbox_decode and import the CSV"
)
"""Reason of the error if the decoder is not installed."""
Decoded = tuple[dict[str, np.ndarray], dict[str, Any], list[Finding]]
"""Columns by the names of `blackbox_decode` (an unusual unit in brackets ends a name), the settings
in the log's header, and notes on several logs in one file and on damaged frames."""


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
    except Exception as error:  # a damaged file can cause any exception in the decoder
        reason = f"a Blackbox log that cannot be decoded ({quoted(error)})"
        raise FlightLogError(str(path), None, None, reason) from None


def _longest(decoder: Any, raw: bytes) -> Decoded:
    """Return the longest log in a file's bytes; the decoder's exceptions pass through."""
    sessions = decoder.split_sessions(raw)
    number, (start, end) = max(enumerate(sessions, start=1), key=lambda s: s[1][1] - s[1][0])
    parser = decoder.FlightLogParser(raw, start, end)
    parser.parse_header()
    parser.parse_data()
    if not parser.main_frames:
        raise ValueError("it has no frame; log again")
    findings = []
    if len(sessions) > 1:
        text = f"holds {len(sessions)} logs; the longest, number {number}, is read"
        findings.append(Finding("note", "file", text))
    damaged = int(parser.stats["total_corrupt_frames"])
    if damaged:
        text = f"{damaged} frames are damaged (a slow memory card?) and left out"
        findings.append(Finding("note", "file", text))
    table = np.array(parser.main_frames, dtype=np.float64).T
    columns = dict(zip(parser.main_field_names, table, strict=True))
    return _in_units(columns, parser.sys_config), parser.sys_config, findings


def _in_units(columns: dict[str, np.ndarray], header: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the columns with rates in deg/s and accelerations in g."""
    counts_per_deg_s = 10.0 if header.get("blackbox_high_resolution") == 1 else 1.0
    counts_per_g = header.get("acc_1G")
    if not isinstance(counts_per_g, (int, float)) or counts_per_g <= 0:
        counts_per_g = ACC_1G
    out = {}
    for name, value in columns.items():
        stem = name.partition("[")[0]
        if stem in ("gyroADC", "gyroUnfilt") or (stem == "setpoint" and name != "setpoint[3]"):
            out[name] = value / counts_per_deg_s
        elif stem == "accSmooth":
            out[f"{name} (g)"] = value / counts_per_g
        else:
            out[name] = value
    return out
