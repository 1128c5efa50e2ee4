"""What a check says about a log: its status, the figures it rests on, the fault's name, its fix."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

STATUSES = ("corrected", "doubt", "not identifiable", "note", "ok")
"""Most serious first."""
SURE = 0.9
"""A doubt at least as sure as this is open: nothing is concluded from its log."""


class Finding(NamedTuple):
    """One statement about a log."""

    status: str
    """`ok` (checked and right), `note` (worth knowing), `corrected` (found wrong, put right),
    `doubt` (looks wrong, left as it is), `not identifiable` (this flight does not show it)."""
    signal: str
    """What it is about: `time`, `attitude`, `velocity`, `thrust`, ..."""
    evidence: str
    """One sentence with the figures that it rests on."""
    fault: str = ""
    """A name of `catalogue.FAULTS`; empty where nothing has a name."""
    size: float | None = None
    """How large the fault is, in the unit that the catalogue says."""
    confidence: float | None = None
    """From 0 to 1 that it is this fault."""
    fix: str = ""
    """Options of `suite import`, or keys of the vehicle file, that put it right."""

    @property
    def is_open(self) -> bool:
        """Whether a diagnosis of the log would name this fault as something else."""
        return self.status == "doubt" and (self.confidence or 0.0) >= SURE and bool(self.fault)


def unseen(signal: str, evidence: str, *faults: str) -> list[Finding]:
    """Return that a flight shows none of `faults`, for the reason in `evidence`."""
    return [Finding("not identifiable", signal, evidence, fault) for fault in faults]


def finding_lines(findings: Iterable[Finding]) -> list[str]:
    """Return the findings as lines for people, the serious ones first."""
    ranked = sorted(findings, key=lambda finding: STATUSES.index(finding.status))
    together: dict[tuple[str, str, str], list[Finding]] = {}
    for finding in ranked:
        together.setdefault((finding.status, finding.signal, finding.evidence), []).append(finding)
    return [
        line(same[0]._replace(fault=", ".join(dict.fromkeys(f.fault for f in same if f.fault))))
        for same in together.values()
    ]


def line(finding: Finding) -> str:
    """Return a finding as one line for people."""
    name = f" [{finding.fault}]" if finding.fault and finding.status != "ok" else ""
    fix = f"; fix: {finding.fix}" if finding.fix and finding.status == "doubt" else ""
    return f"{finding.status:9} {finding.signal}{name}: {finding.evidence}{fix}"


def findings_of(about: Mapping[str, Any]) -> tuple[Finding, ...]:
    """Return the findings in a log's metadata; what is none is left out."""
    old = {"level": "status", "subject": "signal", "text": "evidence"}
    found = []
    records = about.get("findings")
    for record in records if isinstance(records, list) else ():
        if not isinstance(record, dict):
            continue
        fields = {old.get(key, key): value for key, value in record.items()}
        fields = {key: value for key, value in fields.items() if key in Finding._fields}
        if {"status", "signal", "evidence"} <= fields.keys() and fields["status"] in STATUSES:
            found.append(Finding(**fields))
    return tuple(found)
