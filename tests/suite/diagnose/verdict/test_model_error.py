"""The model's own error, as a lower limit of the noise."""

from types import SimpleNamespace

import numpy as np
import pytest

from suite.diagnose.data.colour import Noise
from suite.diagnose.data.whitening import Linearisation
from suite.diagnose.verdict import model_error


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
