"""How large an effect is on these flights, in units of practice; what is too small to matter."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suite.diagnose.data.windows import SLICES
from suite.diagnose.sources.examine import relevant_part
from suite.diagnose.sources.source import TOO_SMALL, sizes_by_effect
from suite.diagnose.thresholds import Thresholds
from suite.diagnose.verdict.gap import Channel, EffectSize, rollout_size, upper_size, view_size
from suite.diagnose.verdict.model_error import beyond_error

LIMITS = Thresholds()


def windows(until_s=1.0, without=()):
    """Return three windows of 101 rows; those up to a time have all but some channel groups."""
    row_s = np.tile(np.linspace(0.0, 1.0, 101), (3, 1))
    seen = np.ones((3, 101, 19), bool) & (row_s <= until_s)[..., None]
    for group in without:
        seen[..., SLICES[group]] = False
    found: Any = SimpleNamespace(row_s=row_s, valid=seen)
    return found


def pushed(acc=0.0, turn=0.0):
    """Return the shift by a constant acceleration along x and angular acceleration about y."""
    time = np.linspace(0.0, 1.0, 101)
    moved = np.zeros((3, 101, 19))
    moved[..., 0], moved[..., 6], moved[..., 10] = 0.5 * acc * time**2, acc * time, turn * time
    return moved


@pytest.mark.parametrize(("until_s", "without"), [(1.0, ()), (0.25, ()), (0.25, ("velocity",))])
def test_a_constant_push_has_its_own_size_however_long_a_stretch_is_trusted(until_s, without):
    size = rollout_size(pushed(0.08, 0.7), windows(until_s, (*without, "accelerometer")))
    assert size.force == pytest.approx(0.08) and size.torque == pytest.approx(0.7)
    assert size.drift == pytest.approx(0.04)


def test_a_bias_of_the_accelerometer_counts_as_a_force_and_a_views_size_is_in_its_own_unit():
    moved = np.zeros((3, 101, 19))
    moved[..., 12] = 0.06
    assert rollout_size(moved, windows()).force == pytest.approx(0.06)
    assert rollout_size(moved, windows(without=("accelerometer",))).force == 0.0
    moved = np.tile([0.3, 0.0, 0.4], (5, 1))
    assert view_size(moved, True) == EffectSize(pytest.approx(0.5), 0.0, None)
    assert view_size(moved, False) == EffectSize(0.0, pytest.approx(0.5), None)


def test_the_upper_end_of_a_size_holds_what_the_interval_allows():
    slope = pushed(1.0)[..., None]

    def size_of(moved):
        return rollout_size(moved, windows())

    upper = upper_size(slope, np.array([0.03]), np.array([0.01]), size_of)
    assert upper.force == pytest.approx(0.04) and not upper.relevant(LIMITS)
    unsure = upper_size(slope, np.array([0.03]), np.array([0.03]), size_of)
    assert unsure.relevant(LIMITS), "a small effect that may be large is no finding of none"


def test_an_effect_that_the_models_own_error_may_be_has_no_size_for_certain():
    """A wide interval is no reason to name it: the effect may be zero."""
    change, width, slope = np.array([0.05]), np.array([0.03]), pushed(1.0)[..., None]
    found: Any = SimpleNamespace(
        named=[SimpleNamespace(candidate=SimpleNamespace(name="clock_offset"))],
        last=SimpleNamespace(evidence=SimpleNamespace(
            space=SimpleNamespace(entries=[SimpleNamespace(effect="clock_offset")]))),
        indices=[0], moved=change, half_widths=lambda: width,
    )  # fmt: skip

    def size_of(moved):
        return rollout_size(moved, windows())

    def upper(error):
        ((size, upper),) = sizes_by_effect(found, slope, size_of, np.array([error])).values()
        assert size.force == pytest.approx(0.05)
        return upper

    assert upper(0.0).force == pytest.approx(0.08)
    assert upper(0.01).force == pytest.approx(0.07)
    assert upper(0.04) == EffectSize(0.0, 0.0, 0.0)


def test_one_parameter_beyond_the_models_error_is_enough():
    change, width = np.array([0.13, -0.12, 0.06]), np.array([0.03, 0.04, 0.05])
    assert not beyond_error(change, np.array([0.20, 0.10, 0.12]), width)
    assert beyond_error(change, np.array([0.20, 0.07, 0.12]), width)
    # Only all parameters together are significant: the error must explain each of them.
    assert beyond_error(change, np.array([0.20, 0.10, 0.12]), 5.0 * width)
    assert not beyond_error(change, np.array([0.20, 0.13, 0.12]), 5.0 * width)


@pytest.mark.parametrize(
    "size", [EffectSize(0.05, 0, 0), EffectSize(0, 0.5, None), EffectSize(0, 0, 0.025)]
)
def test_one_threshold_is_enough_and_none_at_all_keeps_everything(size):
    assert size.relevant(LIMITS)
    below = EffectSize(*(0.99 * (value or 0.0) for value in size))
    assert not below.relevant(LIMITS) and below.relevant(Thresholds(relevance=(0.0, 0.0, 0.0)))


def test_a_gap_matters_beyond_its_noise_by_more_than_the_thresholds(found_drag):
    def matters(error, floor, count=400, limits=LIMITS):
        held = SimpleNamespace(flight=np.zeros(count), start_s=0.25 * np.arange(count))
        source = replace(found_drag.source, held=held, limits=limits)
        groups = dict.fromkeys(("position", "velocity", "rates"), Channel(error, floor))
        return source.is_relevant(found_drag.before._replace(
            channels=dict.fromkeys(("0.1 s", "0.5 s", "1 s"), groups)))  # fmt: skip

    assert not matters(0.004, 0.001) and matters(0.04, 0.001) and not matters(0.04, 0.05)
    assert matters(0.04, 0.04, 4), "few rollouts cannot show that it is small"
    assert matters(0.0, 0.0, limits=Thresholds(relevance=(0.0, 0.0, 0.0)))


def test_where_rollouts_as_given_are_near_enough_no_name_matters(found_drag):
    none = {
        horizon: dict.fromkeys(groups, Channel(1e-3, 0.0))
        for horizon, groups in found_drag.before.channels.items()
    }
    near, source = found_drag.before._replace(channels=none), found_drag.source
    held = source.held._replace(flight=np.zeros(400, int), start_s=0.25 * np.arange(400))
    source = replace(source, held=held)
    found, after, _, out = relevant_part(source, found_drag.search, (near, found_drag.after))
    assert found.named == () and after is near
    ((name, size),) = out
    assert name == "linear_drag" and size.force > 0.05
    rest = source.remaining(found, (near, near), 0)
    assert not rest.structured and rest.reason == TOO_SMALL
