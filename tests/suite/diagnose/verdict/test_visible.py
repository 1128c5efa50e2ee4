"""The smallest constant force and torque that flights show."""

import numpy as np
import pytest

from suite.diagnose.data.windows import KNOTS
from suite.diagnose.thresholds import THRESHOLDS
from suite.diagnose.verdict.residual_structure import DisturbanceEquations, least_visible


def test_the_smallest_visible_push_is_so_many_errors_of_the_worst_axis():
    """Each knot of 7 windows measures each axis once, with a noise of its own."""
    noise = np.array([0.1, 0.2, 0.3, 2.0, 1.0, 0.5])
    hessian = np.tile(np.diag(np.tile(noise**-2.0, KNOTS)), (7, 1, 1))
    unit = np.zeros((7, 6 * KNOTS, 0))
    equations = DisturbanceEquations(hessian, hessian[..., 0], None, unit, [])  # type: ignore[arg-type]
    size = least_visible(equations, None, 0.0)
    errors = np.array([0.3, 2.0]) / np.sqrt(7 * KNOTS)
    np.testing.assert_allclose([size.force, size.torque], THRESHOLDS.visible_sigma * errors)
    assert size.drift is None
    # The model's own error is a share of what coarser inputs change.
    change = np.zeros(6 * KNOTS)
    change[2::6], change[3::6] = 0.04, 0.4
    coarse = equations._replace(gradient=equations.gradient + hessian @ change)
    wide = least_visible(equations, coarse, 0.5)
    assert wide.force == pytest.approx(size.force + 0.02)
    assert wide.torque == pytest.approx(size.torque + 0.2)
    # What nothing shows is not visible at any size.
    hessian[:, ::6], hessian[:, :, ::6] = 0.0, 0.0
    unseen = least_visible(equations, None, 0.0)
    assert unseen.force > 1e4 and unseen.torque == pytest.approx(size.torque)
