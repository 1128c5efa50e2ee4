"""A torch exported program (.pt2) rewritten so that loading it cannot run code.

`torch.export.load` unpickles sample inputs and flagged weights, looks operators up by any dotted
path and evaluates expressions, all from the file. So the file is read here first, as a zip of JSON
and raw numbers; what is known to be harmless is copied into a new archive in memory, and anything
else is refused. Only the copy reaches torch.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from policies.errors import PolicyError
from policies.formats.embedded_spec import KEY
from policies.formats.torch_operators import ATEN, PYTHON

MAX_BYTES = 512 * 2**20
"""Archives that unpack to more than this are refused."""
_PROGRAM = "models/model.json"
_CONFIGS = ("data/weights/model_weights_config.json", "data/constants/model_constants_config.json")
_SAMPLES = "data/sample_inputs/model.pt"
_MARKS = ("archive_format", "archive_version", "byteorder", ".data/version")

_NAME = re.compile(r"-?[A-Za-z_][\w.]*|")
_TARGET = re.compile(r"(torch\.ops\.aten|_operator)\.(\w+)(\.\w+)?")
_PAYLOAD = re.compile(r"(weight|tensor)_\d+")
_WORDS = re.compile(r"[\w ,.>-]*")
_SYMBOL = re.compile(r"Symbol\('[su]\d+'(, \w+=(True|False))*\)")
_EXPRESSION = re.compile(r"([su]\d+|\d+|[-+*/(), ]|Add|Mul|Integer|Mod|FloorDiv|Max|Min)*")
_TREE = re.compile(
    r'("type"|"context"|"children_spec"|"builtins\.(tuple|list|dict)"|"null"|"\[\]"|null'
    r"|[\[\]{}:, 1])*"
)
_SPECIAL = {
    "expr_str": _EXPRESSION,
    "in_spec": _TREE,
    "out_spec": _TREE,
    "as_string": _WORDS,
    "torch_version": re.compile(r"[\w.+-]*"),
}
_REFUSED = ("as_graph", "as_custom_obj", "as_operator", "custom_obj", "token")


@dataclass(frozen=True)
class SafeArchive:
    """A program that can be handed to `torch.export.load`."""

    data: bytes
    """The rewritten archive."""
    spec_text: bytes | None
    """What stands under `embedded_spec.KEY`, if anything."""


def safe_archive(path: Path) -> SafeArchive:
    """Read a .pt2 file and rewrite it.

    Raises:
        PolicyError: where it is no such archive or holds what cannot be shown to be harmless.
    """
    try:
        files = dict(_entries(path))
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, EOFError, RuntimeError) as error:
        raise PolicyError(f"{path}: not a whole .pt2 archive ({error}); export it again") from None
    except OSError as error:
        raise PolicyError(f"{path}: cannot be read ({error.strerror}); check the file") from None
    try:
        kept = _harmless(path, files)
    except RecursionError:
        raise PolicyError(f"{path}: nested too deep; export it again") from None
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in kept.items():
            archive.writestr(f"policy/{name}", data)
    return SafeArchive(buffer.getvalue(), files.get(f"extra/{KEY}"))


def _harmless(path: Path, files: dict[str, bytes]) -> dict[str, bytes]:
    """Return the entries that reach torch, each checked; what is not needed stays out."""
    program = _json(path, files, _PROGRAM)
    # Guards are lines of Python; shapes are checked on our side instead.
    program["guards_code"] = []
    _without_metadata(program)
    for target in _targets(program):
        _check_target(path, target)
    _check_strings(f"{path}: {_PROGRAM}", program, "")
    kept = {name: files[name] for name in _MARKS if name in files}
    kept |= {_PROGRAM: json.dumps(program).encode(), _SAMPLES: b""}
    for name in _CONFIGS:
        config = _json(path, files, name)
        _check_strings(f"{path}: {name}", config, "")
        folder = name.rsplit("/", 1)[0]
        weights = config.get("config")
        for entry in weights.values() if isinstance(weights, dict) else ():
            payload = f"{folder}/{_payload(path, entry)}"
            if payload not in files:
                raise PolicyError(f"{path}: {payload} is missing; export it again")
            kept[payload] = files[payload]
        kept[name] = json.dumps(config).encode()
    return kept


def _entries(path: Path) -> Iterator[tuple[str, bytes]]:
    """Yield (name without the archive's own top folder, content)."""
    with zipfile.ZipFile(path) as archive:
        total = sum(info.file_size for info in archive.infolist())
        if total > MAX_BYTES:
            raise PolicyError(f"{path}: unpacks to {total} bytes, allowed are {MAX_BYTES}")
        for info in archive.infolist():
            yield info.filename.partition("/")[2], archive.read(info)


def _json(path: Path, files: dict[str, bytes], name: str) -> dict[str, Any]:
    if name not in files:
        raise PolicyError(f"{path}: {name} is missing; write the file with torch.export.save")
    try:
        data = json.loads(files[name])
    except ValueError as error:
        raise PolicyError(f"{path}: {name}: not JSON ({error}); export it again") from None
    if not isinstance(data, dict):
        raise PolicyError(f"{path}: {name}: expected an object; export it again")
    return data


def _without_metadata(value: Any) -> None:
    """Empty every "metadata": it is for debuggers, and torch resolves names that stand in it."""
    if isinstance(value, dict):
        for key in value:
            if key == "metadata":
                value[key] = {}
            else:
                _without_metadata(value[key])
    elif isinstance(value, list):
        for entry in value:
            _without_metadata(entry)


def _targets(value: Any) -> Iterator[Any]:
    """Yield whatever stands under a key "target", at any depth."""
    if isinstance(value, dict):
        for key, entry in value.items():
            if key == "target":
                yield entry
            yield from _targets(entry)
    elif isinstance(value, list):
        for entry in value:
            yield from _targets(entry)


def _check_target(path: Path, target: Any) -> None:
    match = _TARGET.fullmatch(target) if isinstance(target, str) else None
    allowed = ATEN if match and match[1] == "torch.ops.aten" else PYTHON
    if not match or match[2] not in allowed:
        raise PolicyError(
            f"{path}: operator {target!r} is not one of those known to be harmless "
            "(policies/formats/torch_operators.py); if you trust who made the file, pass --trust"
        )


def _check_strings(where: str, value: Any, key: str) -> None:
    """Refuse every string that is more than a plain name: torch puts some of them into code."""
    if isinstance(value, dict):
        for name, entry in value.items():
            if name in _REFUSED and entry is not None:
                raise PolicyError(f"{where}: {name!r} is not allowed; pass --trust if you trust it")
            _check_strings(where, name, "")
            _check_strings(where, entry, name)
    elif isinstance(value, list):
        for entry in value:
            _check_strings(where, entry, key)
    elif isinstance(value, str):
        text = _SYMBOL.sub("s0", value) if key == "expr_str" else value
        if len(value) > 2000 or not _SPECIAL.get(key, _NAME).fullmatch(text):
            raise PolicyError(
                f"{where}: {key or 'key'} {value[:60]!r} is not a plain name; export "
                "forward(state, image, hidden) with positional inputs, or pass --trust if you "
                "trust who made the file"
            )


def _payload(path: Path, entry: Any) -> str:
    """Return the name of the file that holds a weight's raw numbers."""
    name = entry.get("path_name") if isinstance(entry, dict) else None
    if not isinstance(name, str) or not _PAYLOAD.fullmatch(name) or entry.get("use_pickle", True):
        raise PolicyError(
            f"{path}: weight {name!r} is pickled or an object, which can run code when loaded; "
            "export plain tensors, or pass --trust if you trust who made the file"
        )
    return name
