"""The `PolicySpec` inside a torch or ONNX file: one JSON object under the key `policy.json`."""

from __future__ import annotations

from typing import Any

from policies.errors import PolicyError
from policies.formats.spec_json import spec_from_json, spec_to_json
from policies.spec import PolicySpec
from tracks.common.files import to_json
from tracks.common.names import unknown_name
from tracks.common.provenance import stamp
from tracks.input.reading import InputError, parse_json

KEY = "policy.json"
"""Name of the extra file in a torch archive, and of the metadata entry in ONNX."""
SCHEMA = 1
KEYS = ("schema", "suite_version", "git_commit", "seed", "name", "spec")
"""Of the object; what a policy says of itself stands under `spec`."""


def embed(spec: PolicySpec, name: str, seed: int | None) -> str:
    """Return the text that goes under `KEY`."""
    data = {**stamp(SCHEMA, seed), "name": name, "spec": spec_to_json(spec)}
    return to_json(data)


def extract(text: str | bytes | None, where: str) -> PolicySpec:
    """Return the spec that a file holds; the default one where it holds none.

    Args:
        text: what stands under `KEY`, or None.
        where: the file, for the message.

    Raises:
        PolicyError: where the text is not JSON, of a newer schema, or not a spec.
    """
    if not text:
        return PolicySpec()
    where = f"{where}: {KEY}"
    try:
        data: Any = parse_json(text, where)
    except InputError as error:
        raise PolicyError(f"{error}; write it again") from None
    if not isinstance(data, dict) or data.get("schema", SCHEMA) != SCHEMA:
        raise PolicyError(f"{where}: expected an object with schema {SCHEMA}; update the suite")
    for key in data:
        if key not in KEYS:
            raise PolicyError(f"{where}: {unknown_name('key', key, KEYS)}")
    return spec_from_json(data.get("spec", {}), f"{where}: spec")
