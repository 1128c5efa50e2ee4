"""A `PolicySpec` as JSON, and the metadata of policy files.

A torch, ONNX or C file has an object under the key `policy.json`, a contract, both or neither.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

from policies import contract
from policies.spec import Note, PolicyError, PolicySpec, check_spec
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
KEYS = ("schema", "suite_version", "git_commit", "seed", "name", "spec", contract.KEY)
"""Keys of the object; `spec` and `contract` describe the policy."""


class PolicyMetadata(NamedTuple):
    """The metadata of a policy file."""

    spec: PolicySpec
    """The default spec where the file has none."""
    contract: contract.Contract | None
    """The file's own contract; None for none."""
    notes: tuple[Note, ...]
    """Assumptions."""


def labels(spec: PolicySpec, name: str, seed: int | None) -> dict[str, str]:
    """Return the texts that go into a policy's file, by their keys."""
    return {KEY: embed(spec, name, seed), contract.KEY: contract.contract_of(spec).text}


def embed(spec: PolicySpec, name: str, seed: int | None) -> str:
    """Return the text that goes under `KEY`."""
    known = contract.contract_of(spec).to_json()
    about = {"name": name, "spec": spec_to_json(spec), contract.KEY: known}
    return to_json({**stamp(SCHEMA, seed), **about})


def extract(texts: Mapping[str, str | bytes | None], where: str) -> PolicyMetadata:
    """Return the metadata of a policy file.

    Args:
        texts: the file's texts under `KEY` and `contract.KEY`, if present.
        where: the file, for the message.

    Raises:
        PolicyError: where a text is not JSON, of a newer schema or no spec, or two contradict.
    """
    about = _object(texts.get(KEY), f"{where}: {KEY}")
    found = [(texts.get(contract.KEY), f"{where}: {contract.KEY}"),
             (about.get(contract.KEY), f"{where}: {KEY}: {contract.KEY}")]  # fmt: skip
    read = [(contract.read_contract(text, place), place) for text, place in found if text]
    if "spec" in about:
        spec = spec_from_json(about["spec"], f"{where}: {KEY}: spec")
        own = contract.contract_of(spec)
        for one, place in read:
            contract.refuse_other(one, own, place, f"the spec in {KEY}")
        return PolicyMetadata(spec, read[0][0] if read else None, ())
    if read:
        for one, place in read[1:]:
            contract.refuse_other(one, read[0][0], place, f"the entry {contract.KEY}")
        return PolicyMetadata(contract.spec_of(*read[0]), read[0][0], ())
    spec = spec_from_json({}, where)
    assumed = contract.summary(contract.contract_of(spec))
    doubt = Note(
        "no_contract",
        f"{where}: no contract in it; assumed: {assumed}",
        "where it was trained otherwise, export it with env.unwrapped.contract",
    )
    return PolicyMetadata(spec, None, (doubt,))


def _object(text: str | bytes | None, where: str) -> dict[str, Any]:
    if not text:
        return {}
    try:
        data: Any = parse_json(text, where)
    except InputError as error:
        raise PolicyError(f"{error}; write it again") from None
    if not isinstance(data, dict) or data.get("schema", SCHEMA) != SCHEMA:
        raise PolicyError(f"{where}: expected an object with schema {SCHEMA}; update the suite")
    for key in data:
        if key not in KEYS:
            raise PolicyError(f"{where}: {unknown_name('key', key, KEYS)}")
    return data
