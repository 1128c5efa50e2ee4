"""Write and read checkpoints: folders with weights.safetensors (arrays) and config.json.

Reading them cannot run code. The config has the weights' SHA-256, so a weights file that is
incomplete, changed or of another checkpoint is refused.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from policies.spec import PolicyError
from tracks.common.files import recover_folder, replacing_folder, to_json
from tracks.common.provenance import stamp
from tracks.input.ranges import shown
from tracks.input.reading import (
    TEXT_BYTES,
    WEIGHTS_BYTES,
    InputError,
    parse_json,
    read_bytes,
    reason,
)

WEIGHTS = "weights.safetensors"
CONFIG = "config.json"
"""Names of the files in a checkpoint."""
KINDS = {
    "policy": "a policy, from suite train",
    "delta": "a Delta Action Model, from suite delta",
    "training": "the state of a training, to continue it",
}
"""Kind of checkpoint -> its name in messages."""
SCHEMA = 1
"""Version of the folder's layout; files of another version are refused."""


@dataclass(frozen=True)
class Stored:
    """Contents of a checkpoint."""

    arrays: dict[str, np.ndarray]
    """Arrays by name, with their saved shapes and types."""
    config: dict[str, Any]
    """The object of config.json: kind, provenance, weights and the caller's keys."""


def save_arrays(
    folder: Path,
    arrays: Mapping[str, Any],
    *,
    kind: str,
    seed: int | None,
    extra: Mapping[str, Any] | None = None,
) -> Path:
    """Write arrays and their description as a checkpoint, replacing an existing one.

    A kill at any moment leaves the complete old checkpoint or the complete new one. The kind is
    "policy", "delta" or "training"; loading requires the same kind. `seed` is that of the training
    or fit, or None. `extra` are further keys of config.json (see `tracks.common.files.to_json`).

    Returns:
        `folder`.

    Raises:
        ValueError: where `extra` has a key that the checkpoint itself writes.
        OSError: where the files cannot be written; an existing checkpoint is kept.
    """
    from safetensors.numpy import save

    # safetensors ignores strides and writes memory as it is, so arrays are made C-contiguous.
    contiguous = {name: np.asarray(value, order="C") for name, value in arrays.items()}
    weights = save(contiguous, metadata={"format": "np"})
    config = {"kind": kind, **stamp(SCHEMA, seed)}
    config["weights"] = {"sha256": hashlib.sha256(weights).hexdigest(), "bytes": len(weights)}
    reserved = sorted(config.keys() & (extra or {}).keys())
    if reserved:
        raise ValueError(f"extra: {reserved} are written by the checkpoint itself; use other names")
    config |= dict(extra or {})
    with replacing_folder(folder) as temporary:
        (temporary / WEIGHTS).write_bytes(weights)
        (temporary / CONFIG).write_text(to_json(config, indent=2) + "\n", encoding="utf-8")
    return folder


def load_arrays(folder: Path, *, kind: str) -> Stored:
    """Read a checkpoint back.

    Raises:
        PolicyError: where a file is missing, cut short, changed, of another kind or a newer
            schema, or an array is not finite; the message names the file and the next step.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    recover_folder(folder)
    config = read_config(folder)
    if config["kind"] != kind:
        raise PolicyError(
            f"{folder / CONFIG}: kind is {shown(config['kind'])}, expected {kind!r}: this is "
            f"{KINDS.get(config['kind'], 'another checkpoint')}; give {KINDS[kind]}"
        )
    path = folder / WEIGHTS
    expected = config["weights"]
    # The size is checked first, before gigabytes are read.
    size = path.stat().st_size if path.is_file() else expected["bytes"]
    if size != expected["bytes"]:
        raise PolicyError(
            f"{path}: {size} bytes, {CONFIG} says {expected['bytes']}; "
            "the file is incomplete or of another checkpoint: copy the whole folder again"
        )
    weights = _read(path, WEIGHTS_BYTES)
    digest = hashlib.sha256(weights).hexdigest()
    if digest != expected["sha256"]:
        raise PolicyError(
            f"{path}: sha256 is {digest[:12]}…, {CONFIG} says {expected['sha256'][:12]}…; "
            "the file was changed or is of another checkpoint: copy the whole folder again"
        )
    try:
        arrays = load(weights)
    except (SafetensorError, KeyError, ValueError) as error:
        raise PolicyError(
            f"{path}: not a safetensors file ({error}); train or copy again"
        ) from None
    check_finite(path, arrays)
    return Stored(arrays, config)


def read_config(folder: Path) -> dict[str, Any]:
    """Read and check only the config.json of a checkpoint.

    Raises:
        PolicyError: where it is missing, is not JSON, or one of the keys that every checkpoint
            has is missing or of the wrong type.
    """
    path = folder / CONFIG
    try:
        config = parse_json(_read(path, TEXT_BYTES), str(path))
    except PolicyError:
        raise
    except InputError as error:
        raise PolicyError(f"{error}; the file is damaged: copy the whole folder again") from None
    if not isinstance(config, dict):
        raise PolicyError(f"{path}: is a {type(config).__name__}, expected an object")
    _require(path, config, "schema", int)
    if config["schema"] != SCHEMA:
        raise PolicyError(
            f"{path}: schema is {config['schema']}, this suite reads {SCHEMA}; "
            "update the suite, or export the checkpoint with the version that wrote it"
        )
    _require(path, config, "kind", str)
    _require(path, config, "weights", dict)
    _require(path, config["weights"], "sha256", str)
    _require(path, config["weights"], "bytes", int)
    return config


def check_finite(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Refuse NaN and infinity in arrays.

    Raises:
        PolicyError: naming the file, the array and how many of its values are not finite.
    """
    for name, value in arrays.items():
        if nonfinite := int(value.size - np.isfinite(value).sum()):
            raise PolicyError(
                f"{path}: {name!r} has {nonfinite} of {value.size} values that are NaN or "
                "infinite; use an earlier checkpoint of that run"
            )


def check_shapes(
    path: Path, arrays: Mapping[str, np.ndarray], expected: Mapping[str, tuple[int, ...]]
) -> None:
    """Refuse arrays whose names, shapes or type (float32) are not the expected ones.

    Raises:
        PolicyError: naming the file, the array, its shape and the shape expected.
    """
    missing, unknown = expected.keys() - arrays.keys(), arrays.keys() - expected.keys()
    if missing or unknown:
        raise PolicyError(
            f"{path}: missing arrays {sorted(missing)}, unknown arrays {sorted(unknown)}; "
            "the weights are of another network: use the version of the suite that wrote them"
        )
    for name, shape in expected.items():
        value = arrays[name]
        if value.shape != shape or value.dtype != np.float32:
            raise PolicyError(
                f"{path}: {name!r} is {value.dtype} {value.shape}, expected float32 {shape}; "
                f"the weights do not fit {CONFIG}"
            )


def _read(path: Path, most_bytes: int) -> bytes:
    """Return the contents of a file of a checkpoint, with errors that name the next step."""
    try:
        return read_bytes(path, most_bytes)
    except FileNotFoundError:
        policy_folder = path.parent / "policy"
        if (policy_folder / CONFIG).is_file():
            text = f"{path.parent}: the folder of a training; give its policy, {policy_folder}"
            raise PolicyError(text) from None
        raise PolicyError(
            f"{path}: missing; a checkpoint is a folder with {WEIGHTS} and {CONFIG}"
        ) from None
    except OSError as error:
        raise PolicyError(f"{path}: cannot be read ({reason(error)}); check the file") from None
    except InputError as error:
        raise PolicyError(f"{error}; check the file") from None


def _require(path: Path, table: Mapping[str, Any], key: str, kind: type) -> None:
    """Refuse a table without a value of type `kind` under `key`."""
    value = table.get(key)
    if not isinstance(value, kind) or isinstance(value, bool):
        raise PolicyError(
            f"{path}: key {key!r} is {shown(value)}, expected a value of type {kind.__name__}; "
            "the file is damaged or not of a checkpoint: copy the whole folder again"
        )
