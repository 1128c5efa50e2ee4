"""The card of an export in C: what it is, how near it is to its policy, and what is known of it."""

from __future__ import annotations

import re
from pathlib import Path

from policies import shipped
from policies.formats.c.arrays import multiply_adds
from policies.formats.c.source import memory_bytes
from policies.formats.policy_file import PolicyCheckpoint
from suite.judging.deploy.parity import Parity
from tracks.common.version import VERSION

CARD = "card.md"
_LICENCE = (
    "Apache-2.0, as diffracing-suite; the checkpoint's maker may say otherwise of the weights"
)


def card_text(
    asked: str, name: str, checkpoint: PolicyCheckpoint, dtype: str, found: Parity
) -> str:
    """Return the card of an export as Markdown.

    Args:
        asked: the policy as it was asked for.
        name: what it is called.
        checkpoint: where it came from.
        dtype: of the weights.
        found: how near it is, and its time a step.
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
        ("a step here", timing),
        ("multiply-adds a step", str(multiply_adds(spec))),
        ("memory of the caller", f"{memory_bytes(spec, dtype == 'int8')} bytes"),
        ("licence", _LICENCE),
    )
    table = "\n".join(f"| {key} | {value} |" for key, value in rows)
    return f"# {name}, {dtype}, in C\n\n| | |\n| --- | --- |\n{table}\n\n{_success(asked)}"


def _success(asked: str) -> str:
    """Return what the policy's own card says of its success, or that nothing is known."""
    path = shipped.locate(asked) / "card.md"
    text = Path(path).read_text(encoding="utf-8") if path.is_file() else ""
    lines = [line for line in text.splitlines() if line.startswith("|") and "success" in line]
    if not lines:
        return "Success: not known; `suite eval --policy . --trust` flies it in the judge.\n"
    whole = text.splitlines()
    first = whole.index(lines[0])
    last = next((k for k in range(first, len(whole)) if not whole[k].startswith("|")), len(whole))
    table = "\n".join(whole[first:last])
    spans = " with 95 % intervals" if re.search(r"\[\d", table) else ""
    return (
        f"Success of the policy that it came from, by its card{spans} "
        f"(`suite eval --policy . --trust` flies the export):\n\n{table}\n"
    )
