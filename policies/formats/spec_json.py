"""A `PolicySpec` as JSON, checked key by key when it is read.

A torch or ONNX file holds one: an object under the key `policy.json`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from policies.spec import PolicyError, PolicySpec, check_spec
from tracks.common.files import to_json
from tracks.common.names import unknown_name
from tracks.common.provenance import stamp
from tracks.common.toml_table import Table
from tracks.input.ranges import shown
from tracks.input.reading import InputError, parse_json


def spec_to_json(spec: PolicySpec) -> dict[str, Any]:
    """Return a spec as a dict of JSON values, nested as the dataclasses are."""
    return dataclasses.asdict(spec)


def spec_from_json(data: Any, where: str) -> PolicySpec:
    """Return the spec that `data` holds; keys that are left out take the default.

    Args:
        data: what `spec_to_json` gave, after JSON.
        where: the file and key it came from, for the message.

    Raises:
        PolicyError: for an unknown key, a wrong type or a value out of range.
    """
    if not isinstance(data, Mapping):
        raise PolicyError(f"{where}: is {shown(data)}, expected a table")
    try:
        spec = Table(where, "", data).read(PolicySpec)
        check_spec(spec, f"{where}: ")
    except ValueError as error:
        raise PolicyError(str(error)) from None
    return spec


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
