"""Marks of parametrised tests."""

import pytest


def more(*values, **options):
    """Return a further case of a parametrised test, which `make test` leaves out."""
    return pytest.param(*values, marks=pytest.mark.extended, **options)
