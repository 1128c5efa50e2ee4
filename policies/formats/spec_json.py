"""Convert a `PolicySpec` to JSON and back, and read the metadata of policy files.

A torch, ONNX or C file may have a JSON object under the key `policy.json`, and a contract (names,
units, frames and scales of its inputs and outputs; see `policies.contract`). The spec is the part
of the contract that the suite reads.
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


def spec_from_json(data: Any, where: str) -> PolicySpec:
    """Return the spec that `data` describes; missing keys take their defaults.

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
"""Version of the object's layout."""
KEYS = ("schema", "suite_version", "git_commit", "seed", "name", "spec", contract.KEY)
"""Keys of the object; `spec` and `contract` describe the policy."""


class PolicyMetadata(NamedTuple):
    """The metadata of a policy file."""

    spec: PolicySpec
    """The file's spec; the default spec if the file has none."""
    contract: contract.Contract | None
    """The file's contract, if it has one."""
    notes: tuple[Note, ...]
    """Assumptions about the policy that the file does not state."""


def labels(spec: PolicySpec, name: str, seed: int | None) -> dict[str, str]:
    """Return the metadata texts for the file of one of the suite's policies, by their keys."""
    text = contract.contract_of(spec, (spec.hidden_size,)).text
    return {KEY: embed(spec, name, seed), contract.KEY: text}


def embed(spec: PolicySpec, name: str, seed: int | None) -> str:
    """Return the JSON text for the key `KEY`: provenance, name, spec and contract."""
    entries = {
        "name": name,
        "spec": dataclasses.asdict(spec),
        contract.KEY: contract.contract_of(spec, (spec.hidden_size,)).to_json(),
    }
    return to_json({**stamp(SCHEMA, seed), **entries})


def extract(texts: Mapping[str, str | bytes | None], where: str) -> PolicyMetadata:
    """Return the metadata of a policy file.

    The texts are under `KEY` and `contract.KEY`, if present.

    Raises:
        PolicyError: where a text is not JSON, has another schema or is not a spec, or where two
            texts contradict each other.
    """
    entries = _object(texts.get(KEY), f"{where}: {KEY}")
    sources = [(texts.get(contract.KEY), f"{where}: {contract.KEY}"),
               (entries.get(contract.KEY), f"{where}: {KEY}: {contract.KEY}")]  # fmt: skip
    contracts = [(contract.read_contract(text, place), place) for text, place in sources if text]
    if "spec" in entries:
        spec = spec_from_json(entries["spec"], f"{where}: {KEY}: spec")
        expected = contract.contract_of(spec)
        for found_contract, place in contracts:
            contract.refuse_differences(found_contract, expected, place, f"the spec in {KEY}")
        return PolicyMetadata(spec, contracts[0][0] if contracts else None, ())
    if contracts:
        first_contract = contracts[0][0]
        for found_contract, place in contracts[1:]:
            contract.refuse_differences(
                found_contract, first_contract, place, f"the entry {contract.KEY}"
            )
        return PolicyMetadata(contract.spec_of(*contracts[0]), first_contract, ())
    spec = spec_from_json({}, where)
    assumed = contract.summary(contract.contract_of(spec))
    note = Note(
        "no_contract",
        f"{where}: no contract in it; assumed: {assumed}",
        "if this is wrong, export it with env.unwrapped.contract",
    )
    return PolicyMetadata(spec, None, (note,))


def _object(text: str | bytes | None, where: str) -> dict[str, Any]:
    """Return the object under `KEY`; refuse other schemas and unknown keys."""
    if not text:
        return {}
    try:
        data: Any = parse_json(text, where)
    except InputError as error:
        raise PolicyError(f"{error}; write it again") from None
    if not isinstance(data, dict):
        raise PolicyError(f"{where}: is {shown(data)}, expected an object such as {{'spec': {{}}}}")
    if data.get("schema", SCHEMA) != SCHEMA:
        raise PolicyError(
            f"{where}: schema is {shown(data['schema'])}, this suite reads {SCHEMA}; "
            "update the suite"
        )
    for key in data:
        if key not in KEYS:
            raise PolicyError(f"{where}: {unknown_name('key', key, KEYS)}")
    return data
