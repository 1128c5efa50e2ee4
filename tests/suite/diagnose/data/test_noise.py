"""The noise of every channel, on residuals whose noise is known."""

import numpy as np
import pytest

from suite.diagnose.data.noise import noise_of, rotor_noise
from suite.diagnose.data.windows import cut
from tests.support.diagnosis_flights import NOISE, fly
from tests.support.vehicles import PLAIN


def test_the_noise_is_seen_under_a_models_error():
    log = fly(PLAIN, 0, duration_s=4.0)
    windows, _ = cut([log], PLAIN, False)
    assert windows is not None
    rng = np.random.default_rng(0)
    time = np.asarray(windows.row_s)[..., None]
    residual = 0.3 * time**2 + 0.002 * rng.standard_normal(windows.valid.shape)
    sigma = noise_of(residual, windows)
    np.testing.assert_allclose(sigma[:12], 0.002, rtol=0.15)
    assert np.isnan(sigma[12:]).all()
    assert NOISE["pos"] == 0.002


def test_the_noise_of_rotor_speeds_that_are_an_input_is_seen_too():
    windows, _ = cut([fly(PLAIN, 0, duration_s=4.0, motors=True)], PLAIN, True)
    assert windows is not None
    # Motors without a lag move between rows, which counts as noise.
    assert rotor_noise(windows) == pytest.approx(NOISE["motor"], rel=0.5)
