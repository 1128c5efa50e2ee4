"""Which format a file is in, by its first bytes."""

from __future__ import annotations

from pathlib import Path

from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError

ULOG = b"ULog\x01\x12\x35"
MCAP = b"\x89MCAP0\r\n"
PARQUET = b"PAR1"
USD = b"\xbc"


def read_head(path: Path) -> bytes:
    """Return the first bytes of the file at `path`.

    Raises:
        FlightLogError: where it cannot be read or is empty.
    """
    try:
        with path.open("rb") as file:
            head = file.read(8192)
    except OSError as error:
        reason = f"cannot be read: {error.strerror or error}"
        raise FlightLogError(str(path), None, None, reason) from None
    if not head:
        raise FlightLogError(str(path), None, None, "the file is empty")
    return head


def detect(path: Path, options: ImportOptions) -> str:
    """Return the name of the format of the file at `path`.

    Raises:
        FlightLogError: where the file cannot be read, or is of no known format.
    """
    head = read_head(path)
    if head.startswith(ULOG):
        return "px4"
    if head.startswith(MCAP):
        return "mcap"
    if head.startswith(PARQUET):
        return "table"
    if head.startswith(USD):
        return "crazyflie"
    if head.startswith(b"H Product:Blackbox"):
        reason = "a Blackbox log that is not decoded; run blackbox_decode on it, import the CSV"
        raise FlightLogError(str(path), None, None, reason)
    first = head.split(b"\n", 1)[0]
    if b"loopIteration" in first or b"gyroADC[" in first:
        return "betaflight"
    if b"\0" not in head and (options.map is not None or b"," in first):
        return "table"
    reason = "of no known format; name it with --format, and a table's columns with --map"
    raise FlightLogError(str(path), None, None, reason)
