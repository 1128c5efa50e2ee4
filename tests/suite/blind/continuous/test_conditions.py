"""Conditions of cases: within their bounds, of every kind, and set by the seed."""

from dataclasses import asdict

import numpy as np

from suite.blind.continuous.timing import CLOCK_S, COLOUR_S, DROPPED, JITTER, draw_conditions


def test_conditions_are_within_bounds_and_of_every_kind():
    drawn = [draw_conditions(np.random.default_rng(seed)) for seed in range(400)]
    values = {name: np.array([asdict(c)[name] for c in drawn]) for name in asdict(drawn[0])}
    for name, low, high in (
        ("loop_hz", 200.0, 2000.0),
        ("row_hz", 50.0, 1000.0),
        ("jitter", 0.0, JITTER),
        ("clock_s", 0.0, CLOCK_S),
        ("dropped", 0.0, DROPPED),
        ("colour_s", *COLOUR_S),
    ):
        assert low <= values[name].min() and values[name].max() <= high, name
        assert values[name].min() < low + 0.1 * (high - low), name
        assert values[name].max() > high - 0.1 * (high - low), name
    assert JITTER == 0.3 and CLOCK_S == 1e-4
    assert (values["row_hz"] <= values["loop_hz"]).all()
    assert 0.4 < (values["coloured"] > 0.0).mean() < 0.6
    assert 0.1 < (values["jitter"] == 0.0).mean() < 0.3
    assert draw_conditions(np.random.default_rng(7)) == drawn[7]
