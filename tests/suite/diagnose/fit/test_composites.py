"""Effects that are one hypothesis: what they are made of, and how a fit of them begins."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suite.diagnose.estimate.block import NormalEquations
from suite.diagnose.estimate.composites import (
    COMPOSITES,
    acts_through,
    begin_of,
    carried,
    composites,
    in_words,
    inactive_at,
    usual_size,
)
from suite.diagnose.estimate.parameters import candidates, effects_in, make_space
from suite.diagnose.search.evaluation import Evaluation, linear_change
from tests.support.vehicles import PLAIN

SPACE = make_space(PLAIN)
SINGLE = candidates(SPACE, False, ())
WHOLE = {one.name: one for one in composites(SINGLE)}
WIND = WHOLE["constant_wind + linear_drag"]


def places(effect):
    return [i for i, entry in enumerate(SPACE.entries) if entry.effect == effect]


def test_a_composite_has_the_numbers_of_all_its_parts():
    assert len(WHOLE) == len(COMPOSITES)
    assert WIND.effects == effects_in(WIND.name) == ("constant_wind", "linear_drag")
    assert list(WIND.indices) == sorted(places("constant_wind") + places("linear_drag"))
    assert [part.name for part in WIND.parts] == list(WIND.effects)
    assert composites([c for c in SINGLE if c.name != "linear_drag"])[0].name != WIND.name
    assert [part.name for part in carried([WIND])] == ["constant_wind"]
    through = {name: acts_through(one) for name, one in WHOLE.items()}
    assert through.pop("mass_offset + com_offset") is False and all(through.values())


def test_a_wind_is_lent_its_slopes_only_where_nothing_passes_it_on():
    theta, acts = SPACE.array("start"), np.ones(len(SPACE.entries), bool)
    assert inactive_at(SPACE, theta, [WIND], acts) is None
    acts[places("constant_wind")] = False
    lent = inactive_at(SPACE, theta, [WIND], acts)
    assert lent is not None and list(lent.indices) == places("constant_wind")
    np.testing.assert_allclose(lent.theta[places("linear_drag")], 0.35)
    assert inactive_at(SPACE, theta, SINGLE, acts) is None
    theta[places("constant_wind")[0]] = 1.0
    assert inactive_at(SPACE, theta, [WIND], acts) is None


def test_a_fit_begins_where_drag_times_wind_is_what_the_slopes_ask_for():
    drag, wind = places("linear_drag"), places("constant_wind")
    usual, change = usual_size(SPACE), np.zeros(len(SPACE.entries))
    change[drag], change[wind] = 0.7, 2.0
    begin = begin_of(SPACE, SPACE.array("start"), WIND, wind, change, np.ones(len(SPACE.entries)))
    assert begin[drag] * begin[wind] == pytest.approx(usual[drag] * change[wind])
    change[drag] = -0.5  # hovering flights ask for none
    begin = begin_of(SPACE, SPACE.array("start"), WIND, wind, change, np.ones(len(SPACE.entries)))
    assert begin[drag].min() > 0.0
    assert begin[drag] * begin[wind] == pytest.approx(usual[drag] * change[wind])


def test_lent_columns_come_last_and_are_a_composites_alone():
    size, lent = len(SPACE.entries), tuple(places("constant_wind"))
    rng = np.random.default_rng(0)
    slope = rng.standard_normal((5, 40, size + 3)) / np.append(SPACE.array("step"), [1.0] * 3)
    slope[..., list(lent)] = 0.0
    moved = slope[..., size:] @ [1.0, -2.0, 0.5]
    turned = np.swapaxes(slope, 1, 2)
    made = NormalEquations(
        turned @ slope,
        (turned @ moved[..., None])[..., 0],
        (moved**2).sum(1),
        along=(*range(size), *lent),
    )
    columns = made.columns_of(WIND)
    assert tuple(made.columns_of(WIND.parts[0])) == lent and set(columns) >= {
        size,
        size + 1,
        size + 2,
    }
    assert sorted(made.numbers[c] for c in columns) == list(WIND.indices)
    evidence: Any = SimpleNamespace(space=SPACE)
    at: Any = SimpleNamespace(theta=SPACE.array("start"))
    change, told = linear_change(
        Evaluation(evidence, at, SimpleNamespace(equations=made)), [], WIND
    )
    np.testing.assert_allclose(change[list(lent)], [1.0, -2.0, 0.5], atol=1e-3)
    assert (told[list(lent)] > 0.0).all() and told[places("frame_tilt")].max() == 0.0


def test_words_say_what_belongs_together_and_what_stands_for_one():
    assert in_words([("linear_drag", "rotor_drag"), ("mass_offset",)]) == []
    both = in_words([("constant_wind",), ("linear_drag",)])
    assert len(both) == 1 and "belong together" in both[0]
    (one,) = in_words([("frame_tilt", "thrust_tilt", WIND.name)])
    assert one.startswith(WIND.name) and "one hypothesis" in one
