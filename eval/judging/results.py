"""Write and read the files of an evaluation: trials.parquet, table.md, summary.json, the journal.

The journal has one line for each finished trial, which is written at once. After a kill, the same
command reads it and flies only the missing trials.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TextIO

from eval.worlds.trial import TrialResult, TrialSpec
from tracks.common.files import naming, plain, replacing_file, to_json, write_json, write_text
from tracks.common.provenance import differences, first_changes, stamp, stamp_text
from tracks.input.reading import LOG_BYTES, check_file, parse_json, read_bytes

SCHEMA = 1
"""Version of the result files."""


def write_results(
    folder: str | os.PathLike[str],
    results: Sequence[TrialResult],
    *,
    table_markdown: str,
    summary: dict[str, Any],
    seed: int | None,
) -> None:
    """Write trials.parquet, table.md and summary.json into `folder`, each completely or not at all.

    The folder is made if missing. Text and summary are from `eval.judging.tables`, the summary
    without the provenance. `seed` is that of the first trial, or None.

    Raises:
        OSError: where the folder cannot be written.
    """
    header = stamp(SCHEMA, seed)
    write_trials(Path(folder) / "trials.parquet", results, header)
    write_text(Path(folder) / "table.md", f"{table_markdown}\n<!-- {stamp_text(header)} -->\n")
    write_json(Path(folder) / "summary.json", {**header, **summary})


def write_trials(
    path: str | os.PathLike[str], results: Sequence[TrialResult], header: dict[str, Any]
) -> None:
    """Write one row for each trial to a Parquet file, with `header` in the metadata key `suite`."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {name: [getattr(result, name) for result in results] for name in TrialResult._fields}
    table = pa.table(columns, schema=pa.schema(_types(), metadata={"suite": to_json(header)}))
    with replacing_file(path) as temporary:
        pq.write_table(table, temporary)


def _kinds() -> dict[str, str]:
    """Return name -> type, as text, of each field of `TrialResult`."""
    annotations = TrialResult.__annotations__.items()
    return {name: getattr(kind, "__forward_arg__", kind) for name, kind in annotations}


def _types() -> dict[str, Any]:
    """Return name -> type in Parquet of each field of `TrialResult`."""
    import pyarrow as pa

    types = {"str": pa.string(), "int": pa.int64(), "float": pa.float64(), "bool": pa.bool_()}
    return {name: types[kind.split(" | ")[0]] for name, kind in _kinds().items()}


def read_trials(path: str | os.PathLike[str]) -> list[TrialResult]:
    """Read the rows of a trials.parquet.

    Raises:
        ValueError: where the file is not a trials.parquet, lacks a column, or has a column of
            another type.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        check_file(path, LOG_BYTES)
        with pq.ParquetFile(path) as file:
            names, table = file.schema_arrow.names, file.read()
    except MemoryError:  # also a subclass of ArrowException
        raise
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        first_line = str(error).splitlines()[0]  # Arrow's messages have several lines
        raise ValueError(
            f"{path}: not a readable Parquet file ({first_line}); run suite eval again"
        ) from error
    columns, types = {}, _types()
    for name, kind in _kinds().items():
        if name not in names and name in TrialResult._field_defaults:
            continue
        if names.count(name) != 1:
            count = names.count(name) or "no"
            raise ValueError(
                f"{path}: {count} columns {name!r}; is it a trials.parquet of this suite?"
            )
        column = table[name]
        if column.type != types[name] or (column.null_count and "None" not in kind):
            raise ValueError(
                f"{path}: column {name!r} holds {column.type}, or cells without a value, where a "
                f"trial has {kind}; is it a trials.parquet of this suite?"
            )
        # All NaN are one object, so that trials with NaN compare equal.
        columns[name] = [math.nan if cell != cell else cell for cell in column.to_pylist()]
    rows = zip(*columns.values(), strict=True)
    return [TrialResult(**dict(zip(columns, row, strict=True))) for row in rows]


class Journal:
    """A file of finished trials, one a line, from which an interrupted evaluation continues.

    The first line has the evaluation's settings. If a kill left an incomplete last line, it is
    dropped.
    """

    def __init__(self, path: str | os.PathLike[str], about: dict[str, Any]) -> None:
        """Open the journal at `path`, made if missing.

        `about` has all settings that determine outcomes, except the trial, as JSON values: policy
        with the hash of its file, vehicle, simulator, options.

        Raises:
            ValueError: where the existing file has other settings.
        """
        self.path = Path(path)
        self.done: dict[TrialSpec, TrialResult] = {}
        """Results read from the file and appended since, by trial."""
        about = plain(about)
        kept_bytes = 0
        if self.path.exists():
            kept_bytes = self._read(about)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with open(self.path, "r+" if kept_bytes else "w", encoding="utf-8") as file:
            if kept_bytes:
                file.truncate(kept_bytes)
            else:
                file.write(to_json({"about": about}) + "\n")
        self._file: TextIO | None = None

    def _read(self, about: dict[str, Any]) -> int:
        """Fill `done` from the file; return the number of bytes of its complete lines."""
        kept_bytes = 0
        for number, line in enumerate(read_bytes(self.path, LOG_BYTES).splitlines(keepends=True)):
            if not line.endswith(b"\n"):
                break
            try:
                entry = parse_json(line, "it")
                result = None if number == 0 else _result(entry)
            except ValueError as error:
                raise ValueError(
                    f"{self.path}: line {number + 1} is not a trial ({error}); move the file away "
                    "to start again"
                ) from error
            if result is not None:
                self.done[result.trial] = result
            elif changes := differences(_settings(entry), about):
                raise ValueError(
                    f"{self.path}: holds trials flown otherwise ({first_changes(changes)}); give "
                    "another --out or move the file away"
                )
            kept_bytes += len(line)
        return kept_bytes

    def append(self, result: TrialResult) -> None:
        """Add a finished trial; when this returns, it survives a kill of this process."""
        with naming(self.path):
            if self._file is None:
                self._file = open(self.path, "a", encoding="utf-8")
            self._file.write(to_json(result._asdict()) + "\n")
            self._file.flush()
        self.done[result.trial] = result

    def missing(self, trials: Iterable[TrialSpec]) -> list[TrialSpec]:
        """Return those of `trials` that are not finished."""
        return [trial for trial in trials if trial not in self.done]

    def others(self, trials: Iterable[TrialSpec]) -> int:
        """Return the number of finished trials outside `trials`."""
        return len(self.done.keys() - set(trials))

    def close(self) -> None:
        """Close the file; `append` opens it again."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _settings(entry: Any) -> dict[str, Any]:
    """Return the settings in a journal's first line; {} where it has none."""
    stored = entry.get("about") if isinstance(entry, dict) else None
    return stored if isinstance(stored, dict) else {}


def _result(entry: Any) -> TrialResult:
    """Return the trial of a journal's line."""
    if not isinstance(entry, dict) or entry.keys() != set(TrialResult._fields):
        raise ValueError("its keys are not those of a trial")
    values = dict(entry)
    for name, kind in _kinds().items():
        if kind == "float" and values[name] is None:  # JSON has no NaN
            values[name] = math.nan
        elif isinstance(values[name], str):  # saves memory: the same texts occur in many trials
            values[name] = sys.intern(values[name])
    return TrialResult(**values)
