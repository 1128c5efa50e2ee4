"""Parquet and CSV files with columns of numbers and one JSON text.

Parquet keeps the text in the metadata key `flight`. CSV keeps it in the first row of a column
`flight`, so that every CSV reader still finds the header in the first line.
"""

from __future__ import annotations

import codecs
import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from eval.logs.columns import KNOWN, FlightLogError
from policies.policy import SUFFIXES
from tracks.common.files import replacing_file
from tracks.input.reading import LOG_BYTES, InputError, check_file, refuse_other_kinds

METADATA = "flight"
"""Parquet metadata key and CSV column of the JSON text."""
MOST_ROWS = 4_000_000
"""Most rows of a flight log: more than an hour at 1 kHz, about a gigabyte in memory."""
MOST_CELLS = 100_000_000
"""Most cells of a flight log, rows times columns: all defined columns at `MOST_ROWS`."""
PARQUET_MAGIC = b"PAR1"
LONGEST_CELL = 2**26
"""Longest cell of a CSV, the one with the metadata [bytes]."""
MOST_BEFORE = 500
"""Most lines of a CSV that are searched for its header."""
OTHERS = {
    "FMT": "an ArduPilot text log, whose messages have columns of their own; export the messages "
    "that you need (ATT, IMU, RATE, RCOU, XKF1) as one table with a time, and describe it by --map",
    "Format Version": "an export of Motive, whose header takes several lines; remove all lines "
    "above the first row of numbers, name the columns in one line (time, x, y, z, qx, qy, qz, qw), "
    "and describe it by --pose-map",
}
"""First cell of other programs' tables that cannot be read directly -> what to do."""
OTHER_MARKS = ";\t"
"""Marks that separate the columns of tables that are not read."""
NO_COMMAS = (
    "the first line has no commas; separate the columns by commas, and write decimals with a point"
)
NO_LOGS = {
    **dict.fromkeys(SUFFIXES, "a policy (suite check --policy)"),
    ".toml": "a track (suite tracks) or a vehicle (suite check --vehicle)",
    ".json": "a JSON file",
}
"""What files are that may be given in place of a flight log, by suffix."""
NOT_CSV = "neither a Parquet file nor CSV in UTF-8"


def read_columns(path: Path) -> tuple[dict[str, np.ndarray], str | None, list[str]]:
    """Read the Parquet or CSV file at `path`; its first bytes decide the format.

    Returns:
        Every column by name with NaN where a number is missing; the JSON text, if any; warnings.

    Raises:
        FlightLogError: where the file is missing, empty, corrupt or neither Parquet nor CSV.
    """
    head = read_head(path)
    if head.startswith(PARQUET_MAGIC):
        return _read_parquet(path)
    if path.suffix.lower() in (".parquet", ".pq"):
        raise FlightLogError(path, "not a Parquet file (or cut at its start); copy it again")
    if other := NO_LOGS.get(path.suffix.lower()):
        raise FlightLogError(path, f"{other}, not a flight log")
    if b"\0" in head:
        raise FlightLogError(path, "neither a Parquet file nor CSV; suite import reads others")
    return _read_csv(path)


def write_columns(path: Path, columns: Mapping[str, np.ndarray], text: str) -> Path:
    """Write `columns` and the JSON `text` to a temporary file, then rename it to `path`.

    Raises:
        FlightLogError: where the ending of `path` is neither `.parquet` nor `.csv`, or a CSV has a
            column `flight`.
        OSError: where the file cannot be written; nothing is left under its name.
    """
    kind = path.suffix.lower()
    if kind not in (".parquet", ".csv"):
        raise FlightLogError(path, "the ending must be .parquet or .csv")
    if kind == ".csv" and METADATA in columns:
        reason = "CSV keeps this name for the metadata; rename it, or write Parquet"
        raise FlightLogError(path, reason, METADATA)
    table = pa.table({name: pa.array(values) for name, values in columns.items()})
    with replacing_file(path) as temporary:
        if kind == ".parquet":
            table = table.replace_schema_metadata({METADATA: text})
            pyarrow.parquet.write_table(table, temporary)
        else:
            rows = [text if k == 0 else None for k in range(table.num_rows)]
            table = table.append_column(METADATA, pa.array(rows, pa.string()))
            pyarrow.csv.write_csv(table, temporary)
    return path


def _read_parquet(path: Path) -> tuple[dict[str, np.ndarray], str | None, list[str]]:
    try:
        # `ParquetFile` instead of `read_table`, which takes a folder's name for a column.
        with pyarrow.parquet.ParquetFile(path) as file:
            wanted, warnings = _wanted(path, file)
            t, schema = pa.types, file.schema_arrow
            kinds = (t.is_string, t.is_large_string, t.is_binary, t.is_large_binary)
            texts = [n for n in wanted if any(is_kind(schema.field(n).type) for is_kind in kinds)]
            metadata = schema.metadata or {}
        # Texts stay dictionary-encoded: a long text in every row would not fit in memory.
        with pyarrow.parquet.ParquetFile(path, read_dictionary=texts) as file:
            table = file.read(wanted)
    except MemoryError:  # before Arrow's errors: one of them is a `MemoryError` as well
        raise
    except (pa.ArrowException, OSError, KeyError, UnicodeDecodeError) as error:
        first = str(error).splitlines()[0]
        reason = f"a corrupt Parquet file ({first}); copy or record it again"
        raise FlightLogError(path, reason) from None
    text = metadata.get(METADATA.encode())
    decoded = None if text is None else text.decode(errors="replace")
    return _arrays(table, path), decoded, warnings


def _wanted(path: Path, file: Any) -> tuple[list[str], list[str]]:
    """Return the columns to read, and a warning about the others."""
    rows, names, schema = file.metadata.num_rows, file.schema_arrow.names, file.schema_arrow
    for name in names:
        if names.count(name) > 1:
            raise FlightLogError(path, "this column is there twice", name)
    nested = {name for name in names if pa.types.is_nested(schema.field(name).type)}
    if known := sorted(nested & KNOWN):
        raise FlightLogError(path, "its cells hold lists; give a number each", known[0])
    wanted = [name for name in names if name not in nested]
    if rows * len(wanted) > MOST_CELLS:
        wanted = [name for name in wanted if name in KNOWN]
    if not wanted:
        wanted = names  # `_check_size` refuses this many
    _check_size(path, rows, len(wanted))
    left = len(names) - len(wanted)
    text = f"{path}: {left} of {len(names)} columns are left out: they hold lists, or are too many"
    return wanted, [text] if left else []


def _read_csv(path: Path) -> tuple[dict[str, np.ndarray], str | None, list[str]]:
    names, before = _csv_header(path)
    _check_text(path, len(names))
    bad_rows: list[Any] = []

    def remember(row: Any) -> str:
        bad_rows.append(row)
        return "skip"

    def parse(numbers: pa.DataType) -> pa.Table:
        bad_rows.clear()
        return pyarrow.csv.read_csv(
            path,
            # One thread: only then does pyarrow report the numbers of bad rows.
            read_options=pyarrow.csv.ReadOptions(
                column_names=names, skip_rows=before + 1, use_threads=False, block_size=LONGEST_CELL
            ),
            parse_options=pyarrow.csv.ParseOptions(invalid_row_handler=remember),
            convert_options=pyarrow.csv.ConvertOptions(
                column_types=dict.fromkeys(KNOWN, numbers), strings_can_be_null=True
            ),
        )

    try:
        try:
            table = parse(pa.float64())
        except pa.ArrowInvalid:
            table = parse(pa.string())  # so that `check_columns` can name the first bad value
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        if "Empty CSV" in str(error):
            raise FlightLogError(path, "a header, but no rows") from None
        first = str(error).splitlines()[0]
        raise FlightLogError(path, f"not readable as CSV ({first})") from None
    warnings = []
    if before:
        warnings.append(f"{path}: the {before} lines before the header are left out")
    last = table.num_rows + len(bad_rows)
    for bad in bad_rows:
        row = bad.number - 1 - before
        reason = f"{bad.actual_columns} values where the header has {bad.expected_columns} columns"
        if row < last:
            raise FlightLogError(path, reason, None, row)
        warnings.append(f"{path}: row {row}, the last, is left out: {reason}")
    if not table.num_rows:
        raise FlightLogError(path, "a header, but no whole rows")
    columns = _arrays(table, path)
    # A column of numbers with the name of the metadata is one of the log's own.
    is_metadata = METADATA in columns and table[METADATA].type in (pa.string(), pa.null())
    text = columns.pop(METADATA)[0] if is_metadata else None
    return columns, text if isinstance(text, str) else None, warnings


def _check_size(path: Path, rows: int, columns: int) -> None:
    """Refuse tables that are too large, before they are read."""
    advice = "cut it into flights, or log less often"
    if rows > MOST_ROWS:
        raise FlightLogError(path, f"{rows:,} rows; at most {MOST_ROWS:,}: {advice}")
    if rows * columns > MOST_CELLS:
        size = f"{rows:,} rows of {columns:,} columns; at most {MOST_CELLS:,} cells"
        raise FlightLogError(path, f"{size}: leave columns out, {advice}")


def _check_text(path: Path, columns: int) -> None:
    """Refuse a file that is not UTF-8, which pyarrow reports at the wrong row."""
    lines = 0
    decode = codecs.getincrementaldecoder("utf-8")().decode
    try:
        with path.open("rb") as file:
            while part := file.read(2**20):
                decode(part)
                lines += part.count(b"\n")
        decode(b"", True)
    except UnicodeDecodeError:
        raise FlightLogError(path, NOT_CSV) from None
    _check_size(path, lines, columns)


def _csv_header(path: Path) -> tuple[list[str], int]:
    """Return the names of the columns, and the number of lines before them."""
    usual_limit = csv.field_size_limit(LONGEST_CELL)
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = [row for row, _ in zip(csv.reader(file), range(MOST_BEFORE), strict=False)]
    except (UnicodeDecodeError, csv.Error):
        raise FlightLogError(path, NOT_CSV) from None
    finally:
        csv.field_size_limit(usual_limit)
    names = [name.strip() for name in lines[0]] if lines else []
    if len(names) == 1 and any(mark in names[0] for mark in OTHER_MARKS):
        raise FlightLogError(path, NO_COMMAS)
    for start, advice in OTHERS.items():
        if names and names[0] == start:
            raise FlightLogError(path, advice)
    before = _lines_before(lines)
    return [name.strip() for name in lines[before]] if lines else [], before


def _lines_before(lines: list[list[str]]) -> int:
    """Return the number of lines before the header.

    A header is a line of names above two rows of the same width, most of them numbers. The result
    is 0 where the first line may be the header, so that errors refer to it.
    """
    if len(lines) < 4 or len(lines[0]) == len(lines[1]) == len(lines[-2]):
        return 0
    for k in range(1, len(lines) - 2):
        width = len(lines[k])
        alike = width == len(lines[k + 1]) == len(lines[k + 2]) and width > len(lines[0])
        numeric = sum(not cell.strip() or _is_number(cell) for cell in lines[k + 1])
        if alike and not any(map(_is_number, lines[k])) and numeric > 0.5 * width:
            return k
    return 0


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _arrays(table: pa.Table, path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a table as arrays; texts are arrays of objects."""
    columns: dict[str, np.ndarray] = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        if not name:
            continue  # commas at the end of the lines
        if name in columns:
            raise FlightLogError(path, "this column is there twice", name)
        if pa.types.is_null(column.type) or pa.types.is_decimal(column.type):
            column = column.cast(pa.float64())
        if pa.types.is_dictionary(column.type):
            column = column.unify_dictionaries().combine_chunks()
            cells = np.array([*column.dictionary.to_pylist(), None], object)
            columns[name] = cells[column.indices.fill_null(len(cells) - 1).to_numpy()]
        else:
            columns[name] = column.to_numpy()
    return columns


def read_head(path: Path) -> bytes:
    """Return the first bytes of the file at `path`.

    Raises:
        FlightLogError: where the file cannot be read or is empty.
    """
    try:
        check_file(path, LOG_BYTES)
        with path.open("rb") as file:
            head = file.read(8192)
        refuse_other_kinds(head, str(path))
    except OSError as error:
        raise FlightLogError(path, f"cannot be read: {error.strerror or error}") from None
    except InputError as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise FlightLogError(path, reason) from None
    if not head:
        raise FlightLogError(path, "the file is empty; record or copy it again")
    return head


def first_line(head: bytes) -> bytes:
    """Return the first line of a text file's head."""
    return head.split(b"\n", 1)[0]
