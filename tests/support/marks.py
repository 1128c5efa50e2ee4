"""Marks of parametrised tests."""

import pytest


def slow(*values, **options):
    """Return a case of a parametrised test that only `-m slow` runs."""
    return pytest.param(*values, marks=pytest.mark.slow, **options)
