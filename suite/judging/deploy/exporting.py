"""`suite export`: write the files, and for C a card with parity and time per step measured here."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from policies import shipped
from policies.formats.c.arrays import multiply_adds
from policies.formats.c.source import memory_bytes
from policies.formats.policy_file import PolicyCheckpoint
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
    """Export a policy of the suite in `formats`; C with a card of parity and time per step.

    Raises:
        ValueError: if the policy is not the suite's, a format or type is unknown, or an export of
            another policy would be overwritten.
    """
    from policies.formats.export import (
        check_formats,
        export_policy,
        exported_checkpoint,
        main_file,
    )
    from policies.native import native_policy

    check_formats(formats, dtype)
    if "c" in formats:
        check_no_input(out / CARD, [shipped.locate(policy) / CARD], "--out")
    name, checkpoint = exported_checkpoint(policy)
    _claim(policy, out, [main_file(name, wanted) for wanted in formats], checkpoint.seed)
    observed = None
    if dtype == "int8":
        console.note("flying 10 random tracks to measure the activations")
        observed = observed_flights(native_policy(checkpoint.params, checkpoint.spec, name))
    written = export_policy(policy, out, formats, dtype, observed)
    if "c" not in formats:
        return {"written": written}
    found = parity(out, checkpoint, observed)
    console.say(found.sentence)
    write_text(out / CARD, card_text(policy, name, checkpoint, dtype, found))
    return {"written": [*written, out / CARD], "parity": found}


def _claim(policy: str, out: Path, files: Sequence[str], seed: int | None) -> None:
    """Record `policy` as the source of `files`, or refuse to overwrite those of another policy.

    File names do not show the policy: every training calls its checkpoint policy/, and the names of
    C files are fixed.

    Raises:
        ValueError: naming the file and what to do.
    """
    source, digest = str(shipped.locate(policy).resolve()), policy_digest(policy)
    noted = _noted(out / NOTE)
    for file in files:
        was = noted.get(file, {})
        if (out / file).exists() and source != was.get("source") and digest != was.get("sha256"):
            whose = was.get("source", "an unrecorded policy")
            raise ValueError(
                f"--out {out}: {file} there was exported from {whose} and would be overwritten by "
                f"that of {policy}; give another --out, or move the file away"
            )
        noted[file] = {"source": source, "sha256": digest}
    write_json(out / NOTE, {**stamp(1, seed), "files": noted})


def _noted(path: Path) -> dict[str, dict[str, str]]:
    if not path.is_file():
        return {}
    try:
        return {file: dict(entry) for file, entry in read_json(path)["files"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: not a record of exports ({error}); move it away") from error


CARD = "card.md"
_LICENCE = "Apache-2.0, as diffracing-suite; the weights may have another licence from their author"


def card_text(
    given: str, name: str, checkpoint: PolicyCheckpoint, dtype: str, found: Parity
) -> str:
    """Return the card of an export as Markdown.

    Args:
        given: the policy as the user named it.
        name: the name of the export.
        checkpoint: the source of the export.
        dtype: type of the weights.
        found: parity with the checkpoint, and time per step.
    """
    spec = checkpoint.spec
    timing = "not measured"
    if found.timing:
        median, p99, most = (f"{1e6 * x:.0f}" for x in found.timing)
        timing = f"median {median} us, 99th percentile {p99} us, longest {most} us (one thread)"
    seed = "unknown" if checkpoint.seed is None else checkpoint.seed
    rows = (
        ("policy", name),
        ("type", dtype),
        ("checkpoint", f"weights.safetensors, SHA-256 `{checkpoint.config['weights']['sha256']}`"),
        ("made by", f"diffracing-suite {VERSION}, training seed {seed}"),
        ("rate", f"{spec.rate_hz:g} Hz"),
        ("parity", found.sentence),
        ("time per step here", timing),
        ("multiply-adds per step", str(multiply_adds(spec))),
        ("memory that the caller provides", f"{memory_bytes(spec, dtype == 'int8')} bytes"),
        ("licence", _LICENCE),
    )
    table = "\n".join(f"| {key} | {markdown_cell(value)} |" for key, value in rows)
    title = f"# {markdown_cell(name)}, {dtype}, in C"
    return f"{title}\n\n| | |\n| --- | --- |\n{table}\n\n{_success(given)}"


def _success(given: str) -> str:
    """Return the success rates in the policy's own card, or a line that they are unknown."""
    path = shipped.locate(given) / "card.md"
    text = Path(path).read_text(encoding="utf-8") if path.is_file() else ""
    lines = [line for line in text.splitlines() if line.startswith("|") and "success" in line]
    if not lines:
        return "Success rate: unknown; `suite eval --policy . --trust` measures it.\n"
    whole = text.splitlines()
    first = whole.index(lines[0])
    last = next((k for k in range(first, len(whole)) if not whole[k].startswith("|")), len(whole))
    table = "\n".join(whole[first:last])
    spans = " with 95 % intervals" if re.search(r"\[\d", table) else ""
    return (
        f"Success rate of the original policy, from its card{spans} "
        f"(`suite eval --policy . --trust` measures that of the export):\n\n{table}\n"
    )
