"""The log of a flight over the link: states and set points at their own times."""

import numpy as np
import pytest

from eval.logs.flight_log import read_flight
from eval.worlds.trial import TrialSpec
from policies.spec import ActionSpec, PolicySpec
from suite.common.console import Console
from suite.judging.link.log import command_jitter_s, write_log
from tests.support.pilots import Steady

pytest.importorskip("pymavlink", reason="pymavlink is not installed (the extra mavlink)")


def test_a_set_point_is_logged_when_it_was_sent(bench, tmp_path):
    one = bench()

    class Computing(Steady):
        def act(self, hidden, state, image, fresh):
            one.now += 0.003
            return super().act(hidden, state, image, fresh)

    one.companion._policy = Computing((0.0, 0.0, 0.0), spec=PolicySpec(rate_hz=50.0))
    one.fly(40).fly(40).fly(40)
    rows = one.companion.rows
    name = write_log(one.companion, TrialSpec("zigzag", 0, 0)._asdict(), tmp_path, Console())
    log = read_flight(tmp_path / str(name))
    is_sent, has_state = np.isfinite(log.thrust_cmd), np.isfinite(log.pos_w[:, 0])
    start_s = rows[0].state.time_s
    state_s = np.array([row.state.time_s for row in rows]) - start_s
    sent_s = np.array([row.sent_s for row in rows]) - start_s
    assert (sent_s > state_s + 0.002).any() and (sent_s < state_s + 1e-9).any()
    # The last one was sent after the last state, if it took time.
    np.testing.assert_allclose(log.time_s[is_sent], sent_s[sent_s <= state_s[-1]], atol=1e-9)
    np.testing.assert_allclose(log.time_s[has_state], state_s, atol=1e-9)
    assert log.policy_step is not None and log.policy_step.sum() == sum(r.decided for r in rows)
    assert has_state[log.policy_step].all(), "a decision is made on a state"
    assert np.isfinite(log.action_b).all()


def test_late_states_show_how_uncertain_the_times_of_set_points_are(bench, tmp_path):
    one, late_s = bench(), np.tile([0.0, 0.004], 100)
    one.show()
    for late in late_s:
        one.tell(one.state(time_s=one.now - late))
        one.now += 0.01
        one.show()
    name = write_log(one.companion, TrialSpec("zigzag", 0, 0)._asdict(), tmp_path, Console())
    log = read_flight(tmp_path / str(name))
    sent_s = [row.sent_s - row.state.time_s for row in one.companion.rows]
    np.testing.assert_allclose(sent_s, late_s, atol=2e-4)
    assert log.about["command_jitter_s"] == pytest.approx(0.002, abs=2e-4)
    # One long delay changes nothing.
    rows = one.companion.rows
    rows[50] = rows[50]._replace(sent_s=rows[50].sent_s + 0.15)
    assert command_jitter_s(rows) == pytest.approx(0.002, abs=2e-4)


def test_a_flight_of_thrust_and_rates_becomes_a_log(bench, tmp_path):
    hover = Steady((9.81, 0.0, 0.0, 0.0), PolicySpec(action=ActionSpec("ctbr")))
    about = TrialSpec("zigzag", 0, 0)._asdict()
    name = write_log(bench(hover).fly(40).fly(40).fly(40).companion, about, tmp_path, Console())
    log = read_flight(tmp_path / str(name))
    assert log.action_b is None
    np.testing.assert_allclose(log.extra["action_thrust"], 9.81, rtol=1e-6)
