"""Stretches of flights by commands of which the log has only some."""

import numpy as np
import pytest

from suite.diagnose.data.windows import cut
from suite.diagnose.sources.input_error import as_likely
from suite.diagnose.sources.rollouts import by_rollouts
from suite.diagnose.sources.source import DiagnosisInput
from suite.diagnose.sources.stretches import LACKING
from suite.diagnose.thresholds import Thresholds
from tests.support import diagnosis_flights
from tests.support.broken_logs import rows
from tests.support.diagnosis_flights import fly_all, without_fault
from tests.support.vehicles import LAGGED, PLAIN


def test_other_commands_between_the_rows_change_no_logged_one():
    log = rows(without_fault(), slice(0, None, 2))
    windows, _ = cut([log], PLAIN, False, between=True)
    logged = windows.command[:, ::2]
    other = as_likely(windows)
    np.testing.assert_array_equal(other.command[:, ::2], logged)
    # They differ from the mean by 2/3 of the variance of a logged one about its neighbours' mean.
    bend = 0.5 * np.diff(logged[0, :40], 2, axis=0)
    size = np.abs(other.command - windows.command)[0, 3:77:2]
    np.testing.assert_allclose(size**2, (bend[:-1] ** 2 + bend[1:] ** 2) / 3.0, atol=1e-12)
    command = other.command[0]
    last = np.isfinite(other.command_s[0]).sum()
    assert (command == windows.command[0])[last - 3 :].all()
    total = np.cumsum(np.diff(other.command_s[0][:last])[:, None] * command[: last - 1], axis=0)
    np.testing.assert_allclose(other.command_sum[0][1:last], total, atol=1e-12)


@pytest.mark.extended
def test_unknown_commands_give_errors_of_the_size_that_counts_as_noise(monkeypatch):
    """A policy with noisy images commands something else in every decision."""
    plain, rng = diagnosis_flights.track, np.random.default_rng(3)

    def restless(*args):
        command = plain(*args)
        thrust = command.thrust + 0.4 * rng.standard_normal(command.thrust.shape)
        return type(command)(thrust, command.rate_b + 0.5 * rng.standard_normal((len(thrust), 3)))

    monkeypatch.setattr(diagnosis_flights, "track", restless)
    flown = fly_all([LAGGED] * 3, range(3), duration_s=9.0, noise=0.0)
    logs = [rows(log, slice(0, None, 2)) for log in flown]
    given = DiagnosisInput(logs, LAGGED, (), "commands", "auto", lambda _: None, Thresholds(), True)
    made = by_rollouts(given)
    assert LACKING in made.warnings
    # Each stretch is one draw of the derivative of chi-square / 2 at the truth, along a parameter.
    # Its variance is the information of the stretch, if the noise is right.
    block = made.sources[0].begin.block
    gradient = np.einsum("wm,wmk->wk", block.residual, block.slope)
    information = np.einsum("wmk,wmk->wk", block.slope, block.slope).sum(axis=0)
    informed = information > 1e-6  # the others do not act on these flights
    ratio = (gradient**2).sum(axis=0)[informed] / information[informed]
    assert len(ratio) > 40 and ratio.max() < 8.0 and np.median(ratio) < 3.0
