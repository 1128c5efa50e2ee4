"""The model's own error, as a lower limit of the noise."""

from types import SimpleNamespace

import numpy as np
import pytest

from suite.diagnose.data.colour import Noise
from suite.diagnose.data.whitening import Linearisation
from suite.diagnose.verdict import model_error
from suite.diagnose.verdict.residual_structure import (
    DisturbanceEquations,
    ResidualStructure,
    ShapeLibrary,
    ShapeScore,
    beyond_model_error,
)


def test_a_window_that_diverges_is_left_out_and_one_without_an_error_counts(monkeypatch):
    def block_of(_, linear, *__):
        return SimpleNamespace(residual=linear.residual.reshape(3, -1))

    monkeypatch.setattr(model_error, "block_of", block_of)
    errors = np.ones((3, 5, 19)) * np.array([2.0, 0.0, 1.0])[:, None, None]
    errors[2, 4, 7] = np.inf
    linear = Linearisation(np.zeros_like(errors), *np.zeros((2, 0)))
    model = SimpleNamespace(residual=lambda *_: errors)
    difference = model_error._difference(model, np.zeros(0), linear, None)
    windows = SimpleNamespace(valid=np.ones(errors.shape, bool))
    rms = model_error._rms(difference, linear, Noise(np.ones(19), {}), None, windows)
    assert rms == pytest.approx(np.full(6, np.sqrt((2.0**2 + 0.0) / 2.0)))


def test_a_shape_that_grows_with_the_models_error_is_left_out_and_one_that_stays_is_kept():
    """Two windows, two knots; the model's error is an x force, the missing physics a z torque."""
    unit = np.zeros((2, 2, 6, 2))
    unit[..., 0, 0], unit[..., 5, 1] = [[1.0, 2.0], [3.0, 1.0]], [[2.0, 1.0], [1.0, 3.0]]
    unit = unit.reshape(2, 12, 2)
    hessian, names = np.tile(100.0 * np.eye(12), (2, 1, 1)), ("force", "torque")

    def of(error, physics):
        gradient = (hessian @ unit @ np.array([error, physics])[..., None])[..., 0]
        return DisturbanceEquations(hessian, gradient, None, ShapeLibrary(unit, ()))

    fine, coarse = of(0.3, 0.2), of(0.9, 0.21)
    found = ResidualStructure([ShapeScore(n, 9.0, 5e-4, (k,)) for k, n in enumerate(names)], {})
    for share, kept in ((0.5, ["torque"]), (0.1, ["force", "torque"])):
        left = beyond_model_error(found, fine, coarse, share)
        assert [shape.label for shape in left.shapes] == kept
    by_chance = found._replace(shapes=[found.shapes[0]._replace(p_value=0.2)])
    assert beyond_model_error(by_chance, fine, coarse, 0.5) == by_chance
