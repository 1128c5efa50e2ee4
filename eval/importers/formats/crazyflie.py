"""Read logs of the Crazyflie's micro SD card deck (uSD).

A file begins with the byte 0xBC, the format's version (1 or 2) and the number of event kinds. Each
kind has a number, a name and its variables, named `group.name(t)` with t a type code of Python's
`struct`. Then come the events: the kind's number, a time (version 1: 32 bits of milliseconds,
version 2: 64 bits of microseconds) and the variables, little-endian and packed. A CRC-32 of all
bytes ends the file; it is missing if the Crazyflie was switched off while logging. Source: the
firmware's documentation of the deck and its log variables (Bitcraze).

The firmware's world is z-up and its body forward-left-up. The mapping file
`eval/importers/mappings/crazyflie.toml` assigns the variables to signals, with units and signs.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import numpy as np

from eval.importers.mapping import recording_of
from eval.importers.mapping_file import read_map
from eval.importers.options import ImportOptions
from eval.importers.signals import Part, Recording
from eval.logs.columns import FlightLogError
from eval.logs.faults.finding import Finding
from eval.logs.files import read_head
from tracks.common.names import closest

SUMMARY = "log of the Crazyflie's micro SD card deck"
USD = b"\xbc"
"""First byte of a log."""
CODES = {code: f"<{code}" for code in "bBhHiIefdqQ"}
"""Type code of a variable, the same in Python's `struct` -> numpy type."""
DEFAULT_MAP = Path("crazyflie")
"""The shipped mapping of the firmware's log variables."""
PACKED = "stateEstimateZ.quat"
"""Variable with a compressed quaternion; see `unpack_quaternion`."""
BACK_S, AHEAD_S = 1.0, 10.0
"""In a file without a checksum, the time from one event to the next must lie between -`BACK_S` and
`AHEAD_S` [s]; otherwise the next event is old content of the card."""


class Kind(NamedTuple):
    """One kind of event."""

    name: str
    variables: tuple[str, ...]
    layout: np.dtype
    """Types of the variables as stored in the file."""


def detect(head: bytes, options: ImportOptions) -> bool:
    """Return whether a file with these first bytes is a log of the deck."""
    return head.startswith(USD)


def read(path: Path, options: ImportOptions) -> Recording:
    """Return the signals of the log at `path`.

    Raises:
        FlightLogError: where the file is not a log of the deck, has an unknown version, or has a
            damaged header.
    """
    if not detect(read_head(path), options):
        raise FlightLogError(path, "not a uSD deck log (its first byte is not BC)")
    events, findings = decode(path.read_bytes(), str(path))
    for event in events.values():
        if PACKED in event:
            quat = unpack_quaternion(event[PACKED])
            event |= {f"{PACKED[:-4]}q{part}": quat[:, k] for k, part in enumerate("wxyz")}

    def missing(variable: str) -> str:
        known = sorted({v for event in events.values() for v in event} - {"timestamp"})
        guess = closest(variable, known)
        return "not logged" + (f"; did you mean {guess!r}?" if guess else "")

    mapping = read_map(options.map or DEFAULT_MAP)
    recording = recording_of(path, mapping, partial(_find, events), missing, options)
    findings = [*findings, *recording.findings]
    return replace(recording, findings=tuple(findings), has_seconds=True)


def decode(data: bytes, name: str) -> tuple[dict[str, dict[str, np.ndarray]], list[Finding]]:
    """Decode the bytes of a log.

    Returns:
        Event name -> variable -> values (N,), with the times [s] under `timestamp`; findings.

    Raises:
        FlightLogError: where the header is damaged or no event follows it.
    """
    try:
        version, kinds, start = _header(data, name)
    except (struct.error, IndexError, KeyError, UnicodeDecodeError, ValueError) as error:
        if isinstance(error, FlightLogError):
            raise
        reason = f"a uSD deck log whose header is broken ({error}); copy it again"
        raise FlightLogError(name, reason) from None
    findings = []
    complete = len(data) > start + 4 and crc32(data[:-4]) == struct.unpack("<I", data[-4:])[0]
    if not complete:
        text = "the checksum is missing or wrong (switched off while logging?); read to the end"
        findings.append(Finding("doubt", "file", text))
    stop = len(data) - 4 if complete else len(data)
    unit_s = 1e-3 if version == 1 else 1e-6
    id_and_time = struct.Struct("<HI" if version == 1 else "<HQ")
    records: dict[int, list[bytes]] = {number: [] for number in kinds}
    offset, last_s, last_kind = start, None, 0
    while offset + id_and_time.size <= stop:
        number = int.from_bytes(data[offset : offset + 2], "little")
        if number not in kinds:
            # A wrong checksum (four bytes) or old content of the card may follow the log.
            if not complete and stop - offset <= 4:
                break
            text = f"byte {offset} starts no known event; {stop - offset} bytes are not read"
            findings.append(Finding("doubt", "file", text))
            break
        end = offset + id_and_time.size + kinds[number].layout.itemsize
        if end > stop:
            break
        time_s = id_and_time.unpack_from(data, offset)[1] * unit_s
        if not complete and last_s is not None and not -BACK_S < time_s - last_s < AHEAD_S:
            text = f"byte {offset} has a time {time_s - last_s:+.3g} s from the event before"
            text += "; the bytes from there are old content of the card, not read"
            findings.append(Finding("doubt", "file", text))
            break
        records[number].append(data[offset + 2 : end])
        offset, last_s, last_kind = end, time_s, number
    if not complete and last_s is not None:
        records[last_kind].pop()  # the last event may be cut, or end in old content of the card
    events = {}
    for number, kind in kinds.items():
        clock = np.dtype([("timestamp", "<u4" if version == 1 else "<u8")])
        layout = np.dtype(clock.descr + (kind.layout.descr if kind.variables else []))
        table = np.frombuffer(b"".join(records[number]), dtype=layout)
        events[kind.name] = {v: table[v].astype(np.float64) for v in kind.variables}
        events[kind.name]["timestamp"] = table["timestamp"].astype(np.float64) * unit_s
    if not any(len(event["timestamp"]) for event in events.values()):
        raise FlightLogError(name, "has a header and no event: nothing was logged")
    return events, findings


def unpack_quaternion(packed: np.ndarray) -> np.ndarray:
    """Return quaternions wxyz (N, 4) from the firmware's 32-bit integers (N,), to about 0.1 deg.

    The two highest bits are the index of the largest of x, y, z, w, which is positive and not
    stored, as the norm is 1. The others follow, each as a sign bit and nine bits of magnitude in
    units of 1 / (511 sqrt(2)).
    """
    bits = packed.astype(np.uint64)
    largest = (bits >> np.uint64(30)).astype(np.int64)
    stored = np.empty((len(bits), 3))
    for k in range(3):
        field = (bits >> np.uint64(10 * (2 - k))) & np.uint64(0x3FF)
        size = (field & np.uint64(0x1FF)).astype(np.float64) / 511.0 * np.sqrt(0.5)
        stored[:, k] = np.where(field >> np.uint64(9), -size, size)
    omitted = np.sqrt(np.clip(1.0 - np.sum(stored**2, axis=1), 0.0, 1.0))
    xyzw = np.empty((len(bits), 4))
    for index in range(4):
        rows = largest == index
        xyzw[rows] = np.insert(stored[rows], index, omitted[rows], axis=1)
    return xyzw[:, [3, 0, 1, 2]]


def _header(data: bytes, name: str) -> tuple[int, dict[int, Kind], int]:
    """Return the version, the event kinds by their numbers, and the offset of the first event."""
    version, count = struct.unpack_from("<HH", data, 1)
    if version not in (1, 2):
        raise FlightLogError(name, f"a uSD deck log of version {version}; 1 and 2 can be read")
    offset = 5
    kinds = {}
    for _ in range(count):
        (number,) = struct.unpack_from("<H", data, offset)
        kind_name, offset = _text(data, offset + 2)
        (width,) = struct.unpack_from("<H", data, offset)
        offset += 2
        fields = []
        for _ in range(width):
            text, offset = _text(data, offset)
            variable, _, code = text.rpartition("(")
            fields.append((variable, CODES[code.rstrip(")")]))
        names = {v for v, _ in fields} - {"", "timestamp"}
        if len(names) < len(fields):
            raise ValueError(f"event {kind_name!r} has a variable with no name or a repeated one")
        kinds[number] = Kind(kind_name, tuple(v for v, _ in fields), np.dtype(fields))
    return version, kinds, offset


def _text(data: bytes, offset: int) -> tuple[str, int]:
    """Return the zero-terminated text at `offset`, and the offset after it."""
    end = data.index(0, offset)
    return data[offset:end].decode("utf-8"), end + 1


def _find(events: Mapping[str, Mapping[str, np.ndarray]], variables: Sequence[str]) -> Part | None:
    """Return time and values of `variables` from the kind of event with most samples of them."""
    having_all = [e for e in events.values() if all(v in e for v in variables)]
    best = max(having_all, key=lambda event: len(event["timestamp"]), default=None)
    if best is None or not len(best["timestamp"]):
        return None
    return best["timestamp"], np.stack([best[v] for v in variables], axis=1)
