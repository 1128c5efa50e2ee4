"""What a policy sees, by hand and with scipy; a row's answer depends on that row alone."""

import dataclasses
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from policies import observation
from policies.block_policy import BlockPolicy, for_one_row, verify_rows
from policies.formats import torch_file
from policies.observation import View, observe, view_of
from policies.policy import load_policy
from policies.spec import NoAnswer, PolicyError, PolicySpec
from tests.support.policy_files import InProcess
from tracks.geometry.camera import Camera
from tracks.geometry.gates import square_gates

EXTRAS = ("second_gate", "gate_axis", "second_axis")
"""In the order in which they follow the twelve numbers."""


@pytest.mark.parametrize("keys", [EXTRAS[:1], EXTRAS[1:2], EXTRAS[2:], EXTRAS[:2], EXTRAS])
def test_what_a_spec_adds_follows_the_twelve_numbers_in_body_axes(keys):
    """Worked with scipy: R^T (p - x) of the second gate, R^T e of both gates' axes."""
    turn = Rotation.from_euler("ZYX", [0.7, -0.3, 0.2])
    pos, vel, gate, last, second = np.random.default_rng(0).normal(size=(5, 3))
    axes = np.array([[0.6, -0.8, 0.0], [0.0, 0.8, 0.6]])
    added = dict(zip(EXTRAS, turn.inv().apply([second - pos, *axes]), strict=True))
    view = View(pos, turn.as_matrix(), vel, gate, second, *axes)
    spec = PolicySpec(**dict.fromkeys(keys, True))
    state, twelve = observe(spec, view, last).state, observe(PolicySpec(), view, last).state
    assert state.shape == (spec.state_size,) and twelve.shape == (12,)
    np.testing.assert_array_equal(state[:12], twelve)
    np.testing.assert_allclose(state[12:], np.ravel([added[key] for key in keys]), atol=1e-12)


def test_how_fast_to_fly_comes_last_as_the_spec_or_each_row_says():
    zero = np.zeros((2, 3))
    ahead = zero + [1.0, 0, 0]
    view = View(zero, np.broadcast_to(np.eye(3), (2, 3, 3)), zero, zero, zero, ahead, ahead)
    axis = PolicySpec(gate_axis=True)
    spec = replace(axis, speed_input=True, speed=0.3)
    assert spec.state_size == 16
    without = observe(axis, view, zero).state
    own = observe(spec, view, zero).state
    np.testing.assert_array_equal(own[:, :15], without)
    np.testing.assert_array_equal(own[:, 15], 0.3)
    observed = observe(spec, view, zero, np.array([0.0, 0.9])).state
    np.testing.assert_array_equal(observed[:, 15], [0.0, 0.9])


def test_what_is_added_is_in_the_order_of_the_spec_as_in_the_contract(monkeypatch):
    monkeypatch.setattr(observation, "EXTRAS", {"speed_input": 1, "gate_axis": 3})
    zero, ahead = np.zeros(3), np.array([1.0, 0.0, 0.0])
    view = View(zero, np.eye(3), zero, zero, zero, ahead, ahead)
    spec = PolicySpec(gate_axis=True, speed_input=True, speed=0.3)
    np.testing.assert_array_equal(observe(spec, view, zero).state[12:], [0.3, 1.0, 0.0, 0.0])


def test_the_papers_twelve_numbers():
    """Rolled a quarter turn to the right, so that its left points up and its top to the right."""
    rolled = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    pos, vel, gate = np.array([1.0, 2.0, 3.0]), np.array([0.0, 5.0, 1.0]), np.array([1.0, 6.0, 2.0])
    view = View(pos, rolled, vel, gate, gate, vel, vel)
    state = observe(PolicySpec(), view, np.array([7.0, 8.0, 9.0])).state
    expected = [0, 1, -5, 0, 1, 0, 0, -1, -4, 7, 8, 9]
    np.testing.assert_allclose(state, expected, atol=1e-15)


def test_depths_are_inverse_and_clipped_on_both_sides():
    """3 / d - 0.6, from 0.3 m to the camera's range of 6 m."""
    spec = PolicySpec(camera=Camera(range_m=6.0))
    zero, depth = np.zeros(3), np.array([[0.1, 0.3], [2.0, 50.0]])
    view = View(zero, np.eye(3), zero, zero, zero, zero, zero, depth)
    image = observe(spec, view, zero).image
    np.testing.assert_allclose(image, [[9.4, 9.4], [0.9, -0.1]], atol=1e-12)
    assert observe(spec, view._replace(depth_m=None), zero).image is None


def test_the_gates_axis_is_its_frames_x():
    one, zero = np.ones(2), np.zeros((2, 3))
    gates = square_gates(zero, np.array([0.0, 0.5 * np.pi]), one, one, one)
    after = square_gates(zero, np.array([np.pi, 0.0]), one, one, one)
    view = view_of(zero, np.tile(np.eye(3), (2, 1, 1)), zero, gates, after, None)
    np.testing.assert_allclose(view.axis_w, [[1, 0, 0], [0, 1, 0]], atol=1e-15)
    np.testing.assert_allclose(view.second_axis_w, [[-1, 0, 0], [1, 0, 0]], atol=1e-15)


@pytest.fixture(scope="module", params=["native", "torch", "onnx"])
def policy(request, checkpoint, exported):
    files = {"native": checkpoint, "torch": "tiny.pt2", "onnx": "tiny.onnx"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch_file, "ModelProcess", InProcess)
        return load_policy(exported / files[request.param], trust=True)


def drawn(seed, n):
    rng = np.random.default_rng(seed)
    state = rng.normal(size=(n, 12)).astype(np.float32)
    image = rng.uniform(-0.3, 9.4, (n, 24, 32)).astype(np.float32)
    return rng.uniform(-1, 1, (n, 64)).astype(np.float32), state, image


@settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 150), data=st.data())
def test_neither_place_nor_neighbours_nor_number_matter(policy, seed, n, data):
    hidden, state, image = drawn(seed, 150)
    fresh = np.random.default_rng(seed).random(150) < 0.3
    alone = policy.act(hidden, state, image, fresh)
    order = np.random.default_rng(seed + 1).permutation(150)[:n]
    others = drawn(seed + 2, n)
    kept = np.random.default_rng(seed + 3).random(n) < data.draw(st.sampled_from([0.1, 0.9]))
    mixed = [
        np.where(kept.reshape(-1, *[1] * (mine.ndim - 1)), mine[order], other)
        for mine, other in zip((hidden, state, image), others, strict=True)
    ]
    for mine, found in zip(alone, policy.act(*mixed, fresh[order]), strict=True):
        assert mine[order][kept].tobytes() == found[kept].tobytes()


def test_a_fresh_row_has_forgotten(policy):
    hidden, state, image = drawn(0, 4)
    fresh = np.array([True, False, True, False])
    with_memory, _ = policy.act(hidden, state, image, fresh)
    without, _ = policy.act(policy.start(4), state, image, np.zeros(4, bool))
    assert (with_memory[fresh] == without[fresh]).all()
    assert (with_memory[~fresh] != without[~fresh]).all()


def test_the_answers_have_the_shapes_promised(policy):
    hidden, state, image = drawn(0, 3)
    action, after = policy.act(hidden, state, image, np.zeros(3, bool))
    assert (action.shape, action.dtype, after.shape) == ((3, 3), np.float32, (3, 64))
    action, after = policy.act(policy.start(0), state[:0], image[:0], np.zeros(0, bool))
    assert (action.shape, after.shape) == ((0, 3), (0, 64))


def place_dependent(state, image, hidden):
    """Adds in another order in the second half, as a kernel for leftover rows may."""
    half = len(state) // 2
    action = np.cumsum(state, 1)[:, -1:] + image[:, 0, :3]
    action[half:] = np.cumsum(state[half:, ::-1], 1)[:, -1:] + image[half:, 0, :3]
    return action, hidden


def neighbour_dependent(state, image, hidden):
    return state[:, :3] - state[:, :3].mean(0), hidden


def test_a_model_whose_rows_depend_on_each_other_is_refused():
    with pytest.raises(PolicyError, match=r"with its batch; .*module.eval\(\)"):
        verify_rows(BlockPolicy("x", PolicySpec(), neighbour_dependent, (0,)), "x")


@pytest.mark.parametrize("block", [64, 7])
def test_a_model_that_rounds_by_place_is_fed_one_by_one(block):
    policy = verify_rows(BlockPolicy("x", PolicySpec(), place_dependent, (0,), block, block), "x")
    assert (policy.rows, policy.block) == (1, block)
    _, state, image = drawn(0, 20)
    none = np.zeros(20, bool)
    action, _ = policy.act(policy.start(20), state, image, none)
    turned, _ = policy.act(policy.start(20), state[::-1], image[::-1], none)
    assert action[::-1].tobytes() == turned.tobytes()


def test_for_one_vehicle_a_row_goes_alone_and_its_answer_is_that_of_the_block(policy):
    hidden, state, image = drawn(1, 1)
    alone = for_one_row(policy)
    if alone is not policy:
        assert (alone.block, alone.rows) == (1, 1)
    none = np.zeros(1, bool)
    found, wanted = (p.act(hidden, state, image, none) for p in (alone, policy))
    for value, expected in zip(found, wanted, strict=True):
        np.testing.assert_allclose(value, expected, atol=1e-4 * max(1, np.abs(expected).max()))


def test_a_checkpoint_takes_one_row_and_what_answers_it_otherwise_keeps_its_block(checkpoint):
    loaded = load_policy(checkpoint)
    assert isinstance(loaded, BlockPolicy) and for_one_row(loaded).block == 1

    def fixed(state, image, hidden):
        if len(state) != 7:
            raise NoAnswer("7 rows, please")
        return state[:, :3], hidden

    for model in (fixed, neighbour_dependent):
        policy = BlockPolicy("x", PolicySpec(), model, (0,), 7, 7)
        assert for_one_row(policy) is policy


def test_a_model_that_rolls_dice_or_has_wrong_outputs_is_refused():
    rng = np.random.default_rng(0)
    base = BlockPolicy("x", PolicySpec(), lambda s, i, h: (s[:, :3], h), (0,))
    assert verify_rows(base, "here") == base
    for model, said in [
        (lambda s, i, h: (rng.random((64, 3), np.float32), h), "two outputs"),
        (lambda s, i, h: (s[:, :4], h), r"here: output 'action' is float32 \(64, 4\)"),
        (lambda s, i, h: (s[:, :3].astype(float), h), "is float64"),
        (lambda s, i, h: (s[:, :3], s), "output 'hidden'"),
    ]:
        with pytest.raises(PolicyError, match=said):
            verify_rows(dataclasses.replace(base, model=model), "here")


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("name", 3, "allowed is a text"),
        ("spec", "race", "a policies.spec.PolicySpec"),
        ("spec", PolicySpec(rate_hz=0.0), "allowed is 1 to 500"),
        ("model", None, "a function (state, image, hidden)"),
        ("hidden_shape", 4, "a tuple of whole numbers"),
        ("hidden_shape", (4.0,), "allowed is a whole number"),
        ("hidden_shape", (-4,), "is (-4,), allowed is 0 to"),
        ("block", "64", "allowed is a whole number"),
        ("block", 0, "allowed is 1 to"),
        ("rows", 7, "allowed is the block, 64, or 1"),
        ("notes", "assumed", "a tuple of Note"),
    ],
)
def test_a_wrong_argument_is_named(name, value, said):
    arguments = {"name": "x", "spec": PolicySpec(), "model": min, "hidden_shape": (0,)}
    with pytest.raises(ValueError, match=rf"BlockPolicy: {name}.*{re.escape(said)}"):
        BlockPolicy(**arguments | {name: value})


@pytest.mark.parametrize("n", [3, 64])
def test_a_memory_that_overflows_is_an_answer_of_nan_for_that_row_alone(n):
    def model(state, image, hidden):
        return state[:, :3], hidden * np.float32(1e30)

    policy = BlockPolicy("grows", PolicySpec(), model, (2,))
    state, image = np.ones((n, 12), np.float32), np.zeros((n, 24, 32), np.float32)
    hidden = np.zeros((n, 2), np.float32)
    hidden[1, 0] = 1.0
    fresh = np.zeros(n, bool)
    action, hidden = policy.act(hidden, state, image, fresh)
    assert np.isfinite(action).all()
    with np.errstate(over="ignore"):
        action, hidden = policy.act(hidden, state, image, fresh)
    assert np.isnan(action[1]).all() and np.isfinite(np.delete(action, 1, 0)).all()
    action, _ = policy.act(hidden, state, image, ~fresh)
    assert np.isfinite(action).all()
