"""Results of the checks of a log: status, evidence, fault and fix."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

STATUSES = ("corrected", "doubt", "not identifiable", "note", "ok")
"""All statuses of a finding, the most serious first; `Finding.status` defines them."""
CUT = "it ends within a message: the rest of the flight may be missing"
"""Evidence of a note about a file that was cut off."""
SURE = 0.9
"""A doubt with at least this confidence is open: a diagnosis refuses its log."""


class Finding(NamedTuple):
    """One result of a check."""

    status: str
    """`ok` (checked, correct), `note` (information), `corrected` (wrong, was corrected), `doubt`
    (probably wrong, unchanged), `not identifiable` (this flight contains no evidence)."""
    signal: str
    """What was checked: `time`, `attitude`, `velocity`, `thrust`, ..."""
    evidence: str
    """One sentence with the measured figures."""
    fault: str = ""
    """Name of the fault, from `catalogue.FAULTS`; empty for none."""
    size: float | None = None
    """Size of the fault, such as the factor of a wrong unit or a delay [s]."""
    confidence: float | None = None
    """Probability of this fault, 0 to 1."""
    fix: str = ""
    """How to correct the fault: options of `suite import`, keys of the vehicle file, or words."""

    @property
    def is_open(self) -> bool:
        """Whether a diagnosis of the log would attribute this fault to a wrong effect."""
        return self.status == "doubt" and (self.confidence or 0.0) >= SURE and bool(self.fault)


def unseen(signal: str, evidence: str, *faults: str) -> list[Finding]:
    """Return findings that `faults` are not identifiable, for the reason in `evidence`."""
    return [Finding("not identifiable", signal, evidence, fault) for fault in faults]


def finding_lines(findings: Iterable[Finding]) -> list[str]:
    """Return the findings as lines of text, the most serious first.

    Findings that differ only in their fault share a line.
    """
    ranked = sorted(findings, key=lambda finding: STATUSES.index(finding.status))
    together: dict[tuple[str, str, str], list[Finding]] = {}
    for finding in ranked:
        together.setdefault((finding.status, finding.signal, finding.evidence), []).append(finding)
    return [
        line(same[0]._replace(fault=", ".join(dict.fromkeys(f.fault for f in same if f.fault))))
        for same in together.values()
    ]


def line(finding: Finding) -> str:
    """Return a finding as one line of text."""
    name = f" [{finding.fault}]" if finding.fault and finding.status != "ok" else ""
    fix = f"; fix: {finding.fix}" if finding.fix and finding.status == "doubt" else ""
    return f"{finding.status:9} {finding.signal}{name}: {finding.evidence}{fix}"


def findings_of(about: Mapping[str, Any]) -> tuple[Finding, ...]:
    """Return the findings in a log's metadata `about`; invalid records are left out."""
    findings = []
    records = about.get("findings")
    for record in records if isinstance(records, list) else ():
        if not isinstance(record, dict):
            continue
        fields = {key: value for key, value in record.items() if key in Finding._fields}
        typed = all(
            isinstance(value, float | int | None if key in ("size", "confidence") else str)
            for key, value in fields.items()
        )
        needed = {"status", "signal", "evidence"} <= fields.keys()
        if typed and needed and fields["status"] in STATUSES:
            findings.append(Finding(**fields))
    return tuple(findings)
