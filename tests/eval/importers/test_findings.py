"""What an import has to say, the serious things first."""

from eval.importers.findings import Finding, said


def test_the_serious_come_first_and_the_rest_in_order():
    findings = (
        Finding("ok", "units", "as they should be"),
        Finding("note", "rows", "at 100 Hz"),
        Finding("doubt", "velocity", "is off"),
        Finding("note", "motors", "put in order"),
        Finding("corrected", "attitude", "is xyzw"),
    )
    assert said(findings) == [
        "corrected attitude: is xyzw",
        "doubt     velocity: is off",
        "note      rows: at 100 Hz",
        "note      motors: put in order",
        "ok        units: as they should be",
    ]
