"""Strengths: what is kept in the committed table, and what is worked out on demand."""

import numpy as np
import pytest

from eval.effects import nameable_effects
from suite.blind.oracle import strength
from suite.blind.oracle.strength import columns_in_table, detectable_along, strengths
from tests.support.faults import with_imu_fault


@pytest.fixture(autouse=True)
def nothing_kept():
    strength._entry.cache_clear()
    yield
    strength._entry.cache_clear()


@pytest.mark.slow
def test_the_committed_table_is_what_is_worked_out():
    stored = strength._load()["vehicles"]["dragged"]["full"]
    found = strengths("dragged", "full", ["rotor_drag", "clock_offset", "weak_motor", "gusts"])
    for name, entry in found.items():
        assert entry["columns"] == stored[name]["columns"]
        for key in ("matrix", "detectable"):
            if key in entry:
                np.testing.assert_allclose(entry[key], stored[name][key], rtol=1e-6)
    assert list(stored) and set(stored) == set(nameable_effects())


def test_an_effect_that_is_not_in_the_table_is_worked_out(monkeypatch):
    with_imu_fault(monkeypatch)
    columns = columns_in_table("bare", "full", "imu_fault")
    assert [tuple(c[1:]) for c in columns] == [
        ("turn", 0), ("turn", 1), ("turn", 2), ("scale", 0), ("late", 0)
    ]  # fmt: skip
    late = detectable_along("bare", "full", "imu_fault", np.eye(5)[4])
    by_clock = detectable_along("bare", "full", "clock_offset", np.ones(1))
    assert late == pytest.approx(by_clock, rel=1e-3), "the same fault under another name"
    turned = detectable_along("bare", "full", "imu_fault", np.eye(5)[0])
    assert 0.0 < turned < 0.01
