"""Two cases of a blind set, small enough for tests."""

from suite.blind.cases import Case

SINGLE = Case("single", ("linear_drag",), 6.0, "bare", "estimator", (5, 1))
NULL = Case("null", (), 0.0, "dragged", "capture", (5, 2))
