"""Export a policy to other formats (`suite export`).

An export in C is compiled, and its actions are compared with those of the original policy (parity).
Its card has the largest difference and the time per step.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from policies import shipped
from policies.formats.c.arrays import multiply_adds
from policies.formats.c.source import memory_bytes
from policies.formats.export import check_formats, export_policy, exported_checkpoint, file_names
from policies.formats.policy_file import PolicyCheckpoint
from policies.native import native_policy
from suite.common.console import Console
from suite.judging.content import policy_digest
from suite.judging.deploy.parity import Parity, observed_flights, parity
from tracks.common.files import check_no_input, write_json, write_text
from tracks.common.grid import markdown_cell
from tracks.common.provenance import VERSION, stamp
from tracks.input.reading import read_json

NOTE = "exports.json"
"""Name of the file in the output folder that records the source policy of each export."""


def export(
    policy: str, out: Path, formats: Sequence[str], dtype: str, console: Console
) -> dict[str, Any]:
    """Export a policy of the suite in `formats`; an export in C gets a card.

    Formats are such as "onnx" and "c"; the type of the weights is float32 or int8.

    Returns:
        `written`, the paths of the files; for C also `parity`, the result of the comparison.

    Raises:
        ValueError: if the policy is not the suite's, a format or type is unknown, or an export of
            another policy would be overwritten.
    """
    check_formats(formats, dtype)
    if "c" in formats:
        check_no_input(out / CARD, [shipped.locate(policy) / CARD])
    name, checkpoint = exported_checkpoint(policy)
    files = [(*file_names(name, each), *[CARD] * (each == "c")) for each in formats]
    _record_source(policy, out, files, checkpoint.seed)
    for note in checkpoint.notes(policy):
        console.note(str(note))
    # Inputs in flight set the scales of the activations in 8 bits.
    observed = None
    if dtype == "int8":
        console.note("flying 10 random tracks to measure the activations")
        observed = observed_flights(native_policy(checkpoint.params, checkpoint.spec, name))
    written = export_policy(policy, out, formats, dtype, observed)
    if "c" not in formats:
        return {"written": written}
    # If the comparison fails, no card of an earlier export may stay.
    (out / CARD).unlink(missing_ok=True)
    result = parity(out, checkpoint, observed)
    console.say(result.sentence)
    write_text(out / CARD, card_text(policy, name, checkpoint, dtype, result))
    return {"written": [*written, out / CARD], "parity": result}


def _record_source(
    policy: str, out: Path, exports: Sequence[Sequence[str]], seed: int | None
) -> None:
    """Record `policy` as the source of `exports`, or refuse to overwrite files of another origin.

    The record is needed because file names do not show the policy: every training calls its
    checkpoint policy/, and the names of C files are fixed. An export is recorded under the name of
    its first file.

    Raises:
        ValueError: naming the file and what to do.
    """
    source, digest = str(shipped.locate(policy).resolve()), policy_digest(policy)
    path, records = out / NOTE, {}
    if path.is_file():
        try:
            records = {file: dict(entry) for file, entry in read_json(path)["files"].items()}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}: not a record of exports ({error}); move it away") from error
    for files in exports:
        old = records.get(files[0], {})
        present = [file for file in files if (out / file).exists()]
        # The same policy may be exported again, also from another place or with new weights.
        if present and source != old.get("source") and digest != old.get("sha256"):
            origin = f"is not recorded in {NOTE}"
            if "source" in old:
                origin = f"was exported from {old['source']}"
            raise ValueError(
                f"--out {out}: {present[0]} {origin} and would be overwritten by the export of "
                f"{policy}; give another --out, or move the file away"
            )
        records[files[0]] = {"source": source, "sha256": digest}
    write_json(path, {**stamp(1, seed), "files": records})


CARD = "card.md"
"""Name of the card in the folder of a policy or an export."""
_LICENCE = "Apache-2.0, as diffracing-suite; the weights may have another licence from their author"


def card_text(
    source: str, name: str, checkpoint: PolicyCheckpoint, dtype: str, result: Parity
) -> str:
    """Return the card of an export as Markdown; `source` is the policy as the user gave it."""
    spec = checkpoint.spec
    timing = "not measured"
    if result.timing:
        median, p99, longest = (f"{1e6 * seconds:.0f}" for seconds in result.timing)
        timing = f"median {median} us, 99th percentile {p99} us, longest {longest} us (one thread)"
    seed = "unknown" if checkpoint.seed is None else checkpoint.seed
    rows = (
        ("policy", name),
        ("type", dtype),
        ("checkpoint", f"weights.safetensors, SHA-256 `{checkpoint.config['weights']['sha256']}`"),
        ("made by", f"diffracing-suite {VERSION}, training seed {seed}"),
        ("rate", f"{spec.rate_hz:g} Hz"),
        ("parity", result.sentence),
        ("time per step here", timing),
        ("multiply-adds per step", str(multiply_adds(spec))),
        ("memory that the caller provides", f"{memory_bytes(spec, dtype == 'int8')} bytes"),
        ("licence", _LICENCE),
    )
    table = "\n".join(f"| {key} | {markdown_cell(value)} |" for key, value in rows)
    title = f"# {markdown_cell(name)}, {dtype}, in C"
    return f"{title}\n\n| | |\n| --- | --- |\n{table}\n\n{_success_rates(source)}"


def _success_rates(source: str) -> str:
    """Return the table of success rates in the card of the policy, or a line that has none."""
    path = shipped.locate(source) / CARD
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    lines = text.splitlines()
    headers = [k for k, line in enumerate(lines) if line.startswith("|") and "success" in line]
    if not headers:
        return "Success rate: unknown; `suite eval --policy . --trust` measures it.\n"
    # The first table with a column of success, to its last line.
    first = headers[0]
    last = next((k for k in range(first, len(lines)) if not lines[k].startswith("|")), len(lines))
    table = "\n".join(lines[first:last])
    spans = " with 95 % intervals" if re.search(r"\[\d", table) else ""
    return (
        f"Success rate of the original policy, from its card{spans} "
        f"(`suite eval --policy . --trust` measures that of the export):\n\n{table}\n"
    )
