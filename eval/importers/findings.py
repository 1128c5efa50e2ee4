"""What an import has to say about a log: every check, every correction, every doubt."""

from __future__ import annotations

from typing import NamedTuple


class Finding(NamedTuple):
    """One statement about an imported log."""

    level: str
    """`ok` (checked and as it should be), `note` (worth knowing), `corrected` (found wrong and put
    right), `doubt` (looks wrong, left as it is)."""
    subject: str
    """What it is about: `time`, `attitude`, `velocity`, `thrust`, ..."""
    text: str
    """One sentence with the figures that it rests on."""


def said(findings: tuple[Finding, ...]) -> list[str]:
    """Return the findings as lines for people, the serious ones first."""
    order = ("corrected", "doubt", "note", "ok")
    ranked = sorted(findings, key=lambda finding: order.index(finding.level))
    return [f"{finding.level:9} {finding.subject}: {finding.text}" for finding in ranked]
