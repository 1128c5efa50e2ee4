"""Logs of the Crazyflie's micro SD card deck.

A file is the byte 0xBC, the format's version (1 or 2) and the number of event kinds; each kind
has a number, a name and its variables, named `group.name(t)` with t a type code of Python's
`struct`. Events follow: the kind's number, a time (version 1: 32 bits of milliseconds, version 2:
64 bits of microseconds) and the variables, little-endian and packed. A CRC-32 of all that ends
the file; a Crazyflie that was switched off while logging leaves it out. Source: the firmware's
documentation of the deck and its log variables (Bitcraze).

The firmware's world is z-up and its body forward-left-up. Which variable is what, in which unit
and sign, is said by `eval/importers/mappings/crazyflie.toml`.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import numpy as np

from eval.importers.mapping import recording_of
from eval.importers.mapping_file import read_map
from eval.importers.options import ImportOptions
from eval.importers.signals import Recording
from eval.logs.columns import FlightLogError
from eval.logs.faults.finding import Finding
from eval.logs.files import read_head
from tracks.common.names import closest

SUMMARY = "log of the Crazyflie's micro SD card deck"
USD = b"\xbc"
CODES = {"b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4"} | {
    "e": "<f2",
    "f": "<f4",
    "d": "<f8",
    "q": "<i8",
    "Q": "<u8",
}
"""Type codes of variables as numpy types."""
DEFAULT_MAP = Path("crazyflie")
"""The shipped mapping of the firmware's log variables."""
PACKED = "stateEstimateZ.quat"
BACK_S, AHEAD_S = 1.0, 10.0
"""Without a checksum, an event this far from the one before is the card's old content [s]."""


class Kind(NamedTuple):
    """One kind of event."""

    name: str
    variables: tuple[str, ...]
    layout: np.dtype


def detect(head: bytes, options: ImportOptions) -> bool:
    """Return whether a file with these first bytes is a log of the deck."""
    return head.startswith(USD)


def read(path: Path, options: ImportOptions) -> Recording:
    """Return the signals of the log at `path`.

    Raises:
        FlightLogError: where it is no such log, of an unknown version, or broken in its header.
    """
    if not detect(read_head(path), options):
        raise FlightLogError(str(path), None, None, "not a uSD deck log (its first byte is not BC)")
    events, findings = decode(path.read_bytes(), str(path))
    for event in events.values():
        if PACKED in event:
            quat = unpack_quaternion(event[PACKED])
            event |= {f"{PACKED[:-4]}q{part}": quat[:, k] for k, part in enumerate("wxyz")}

    def missing(variable: str) -> str:
        known = sorted({v for event in events.values() for v in event} - {"timestamp"})
        guess = closest(variable, known)
        return "not logged" + (f"; did you mean {guess!r}?" if guess else "")

    recording = recording_of(
        path,
        read_map(options.map or DEFAULT_MAP),
        lambda variables: _find(events, variables),
        missing,
        options,
    )
    return replace(recording, findings=(*findings, *recording.findings))


def decode(data: bytes, name: str) -> tuple[dict[str, dict[str, np.ndarray]], list[Finding]]:
    """Return event name -> variable -> values, with the times [s] under `timestamp`.

    Raises:
        FlightLogError: where the header is broken or nothing follows it.
    """
    try:
        version, kinds, start = _header(data, name)
    except (struct.error, IndexError, KeyError, UnicodeDecodeError, ValueError) as error:
        if isinstance(error, FlightLogError):
            raise
        reason = f"a uSD deck log whose header is broken ({error}); copy it again"
        raise FlightLogError(name, None, None, reason) from None
    findings = []
    whole = len(data) > start + 4 and crc32(data[:-4]) == struct.unpack("<I", data[-4:])[0]
    if not whole:
        text = "the checksum is missing or wrong (switched off while logging?); read to the end"
        findings.append(Finding("doubt", "file", text))
    stop = len(data) - 4 if whole else len(data)
    unit = 1e-3 if version == 1 else 1e-6
    stamp = struct.Struct("<HI" if version == 1 else "<HQ")
    found: dict[int, list[bytes]] = {number: [] for number in kinds}
    at, last, newest = start, None, 0
    while at + stamp.size <= stop:
        number = int.from_bytes(data[at : at + 2], "little")
        if number not in kinds:
            # Without a checksum its four bytes, or the card's old content, may follow the log.
            if not whole and stop - at <= 4:
                break
            text = f"byte {at} starts no known event; {stop - at} bytes after it are not read"
            findings.append(Finding("doubt", "file", text))
            break
        end = at + stamp.size + kinds[number].layout.itemsize
        if end > stop:
            break
        when = stamp.unpack_from(data, at)[1] * unit
        if not whole and last is not None and not -BACK_S < when - last < AHEAD_S:
            text = f"byte {at} has a time {when - last:+.3g} s from the one before: what follows is"
            findings.append(Finding("doubt", "file", f"{text} the card's old content, not read"))
            break
        found[number].append(data[at + 2 : end])
        at, last, newest = end, when, number
    if not whole and last is not None:
        found[newest].pop()  # cut within it, or its end is the card's old content
    events = {}
    for number, kind in kinds.items():
        clock = np.dtype([("timestamp", "<u4" if version == 1 else "<u8")])
        layout = np.dtype(clock.descr + (kind.layout.descr if kind.variables else []))
        table = np.frombuffer(b"".join(found[number]), dtype=layout)
        events[kind.name] = {v: table[v].astype(np.float64) for v in kind.variables}
        events[kind.name]["timestamp"] = table["timestamp"].astype(np.float64) * unit
    if not any(len(event["timestamp"]) for event in events.values()):
        raise FlightLogError(name, None, None, "holds a header and no event: nothing was logged")
    return events, findings


def unpack_quaternion(packed: np.ndarray) -> np.ndarray:
    """Return quaternions wxyz (N, 4) of the firmware's 32-bit form, good to about 0.1 deg.

    The two highest bits number the largest of x, y, z, w, which is left out and positive; the
    others follow in order, each a sign and nine bits that count to 1/sqrt(2).
    """
    bits = packed.astype(np.uint64)
    largest = (bits >> np.uint64(30)).astype(np.int64)
    small = np.empty((len(bits), 3))
    for k in range(3):
        part = (bits >> np.uint64(10 * (2 - k))) & np.uint64(0x3FF)
        size = (part & np.uint64(0x1FF)).astype(np.float64) / 511.0 * np.sqrt(0.5)
        small[:, k] = np.where(part >> np.uint64(9), -size, size)
    rest = np.sqrt(np.clip(1.0 - np.sum(small**2, axis=1), 0.0, 1.0))
    xyzw = np.empty((len(bits), 4))
    for index in range(4):
        rows = largest == index
        xyzw[rows] = np.insert(small[rows], index, rest[rows], axis=1)
    return xyzw[:, [3, 0, 1, 2]]


def _header(data: bytes, name: str) -> tuple[int, dict[int, Kind], int]:
    version, count = struct.unpack_from("<HH", data, 1)
    if version not in (1, 2):
        reason = f"a uSD deck log of version {version}; 1 and 2 can be read"
        raise FlightLogError(name, None, None, reason)
    at = 5
    kinds = {}
    for _ in range(count):
        (number,) = struct.unpack_from("<H", data, at)
        kind_name, at = _text(data, at + 2)
        (width,) = struct.unpack_from("<H", data, at)
        at += 2
        fields = []
        for _ in range(width):
            text, at = _text(data, at)
            variable, _, code = text.rpartition("(")
            fields.append((variable, CODES[code.rstrip(")")]))
        names = {v for v, _ in fields} - {"", "timestamp"}
        if len(names) < len(fields):
            raise ValueError(f"a variable of event {kind_name!r} has no name of its own")
        kinds[number] = Kind(kind_name, tuple(v for v, _ in fields), np.dtype(fields))
    return version, kinds, at


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(0, at)
    return data[at:end].decode("utf-8"), end + 1


def _find(
    events: Mapping[str, Mapping[str, np.ndarray]], variables: Sequence[str]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return time and values of `variables` from the event that holds them most often."""
    holding = [e for e in events.values() if all(v in e for v in variables)]
    best = max(holding, key=lambda event: len(event["timestamp"]), default=None)
    if best is None or not len(best["timestamp"]):
        return None
    return best["timestamp"], np.stack([best[v] for v in variables], axis=1)
