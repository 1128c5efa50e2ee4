"""What `suite export` does: the files, and for C what they are worth on this machine."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from policies import shipped
from suite.common.console import Console
from suite.judging.deploy.card import CARD, card_text
from suite.judging.deploy.observed import observed_flights
from suite.judging.deploy.parity import parity
from tracks.common.files import check_no_input, write_text


def export(
    policy: str, out: Path, formats: Sequence[str], dtype: str, console: Console
) -> dict[str, Any]:
    """Write a policy of ours in `formats`; C with a card of its parity and its time a step.

    Raises:
        ValueError: where the policy is not ours, or a format or type is unknown.
    """
    from policies.formats.export import check_formats, export_policy, exported_checkpoint
    from policies.native import native_policy

    check_formats(formats, dtype)
    if "c" in formats:
        check_no_input(out / CARD, [shipped.locate(policy) / CARD], "--out")
    name, checkpoint = exported_checkpoint(policy)
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
