"""Numbers as text for people."""

from __future__ import annotations


def rounded(value: float, digits: int) -> str:
    """Return `value` with `digits` significant digits; a large number has all before the point.

    So 123.4 with two digits is "123", not "1.2e+02".
    """
    if abs(value) < 10.0**digits - 0.5:
        return f"{value:.{digits}g}"
    return f"{value:,.0f}"


def with_unit(text: str, unit: str) -> str:
    """Return `text`, a number, with its unit; the unit "1" is left out."""
    return text if unit in ("", "1") else f"{text} {unit}"
