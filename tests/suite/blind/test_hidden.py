"""What is hidden in a vehicle, at the strength that was asked for."""

import numpy as np
import pytest

from eval.effects import EFFECTS, nameable_effects
from suite.blind.oracle.strength import columns_in_table, detectable_along, given_vehicle
from suite.blind.outside import changed_values, draw_change


def test_a_strength_is_the_multiple_of_the_table_or_cut_at_a_bound():
    nominal = given_vehicle("bare")
    for name in nameable_effects():
        vehicle = nominal if name not in ("constant_wind", "gusts") else given_vehicle("dragged")
        rng = np.random.default_rng(3)
        change, multiple = draw_change(rng, vehicle, "full", name, 2.0)
        values = changed_values(vehicle, "full", name, change, rng)
        assert multiple <= 2.0 and np.abs(change).max() > 0.0, name
        direction = change / np.linalg.norm(change)
        unit = detectable_along(vehicle.name, "full", name, direction)
        assert np.linalg.norm(change) / unit == pytest.approx(multiple, rel=1e-6), name
        assert len(columns_in_table(vehicle.name, "full", name)) == len(change)
        assert isinstance(values, EFFECTS[name].values)
