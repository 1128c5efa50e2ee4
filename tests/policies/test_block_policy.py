"""A row's answer depends on that row alone, to the bit, in every kind of policy."""

import dataclasses

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from policies.block_policy import BlockPolicy, for_one_row, verify_rows
from policies.formats import torch_file
from policies.policy import load_policy
from policies.spec import NoAnswer, PolicyError, PolicySpec
from tests.support.policy_files import InProcess


@pytest.fixture(scope="module", params=["native", "torch", "onnx"])
def policy(request, checkpoint, exported):
    files = {"native": checkpoint, "torch": "tiny.pt2", "onnx": "tiny.onnx"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch_file, "ModelProcess", InProcess)
        return load_policy(exported / files[request.param], trust=True)


def observe(seed, n):
    rng = np.random.default_rng(seed)
    state = rng.normal(size=(n, 12)).astype(np.float32)
    image = rng.uniform(-0.3, 9.4, (n, 24, 32)).astype(np.float32)
    return rng.uniform(-1, 1, (n, 64)).astype(np.float32), state, image


@settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 150), data=st.data())
def test_neither_place_nor_neighbours_nor_number_matter(policy, seed, n, data):
    hidden, state, image = observe(seed, 150)
    fresh = np.random.default_rng(seed).random(150) < 0.3
    alone = policy.act(hidden, state, image, fresh)
    order = np.random.default_rng(seed + 1).permutation(150)[:n]
    others = observe(seed + 2, n)
    kept = np.random.default_rng(seed + 3).random(n) < data.draw(st.sampled_from([0.1, 0.9]))
    mixed = [
        np.where(kept.reshape(-1, *[1] * (mine.ndim - 1)), mine[order], other)
        for mine, other in zip((hidden, state, image), others, strict=True)
    ]
    for mine, found in zip(alone, policy.act(*mixed, fresh[order]), strict=True):
        assert mine[order][kept].tobytes() == found[kept].tobytes()


def test_a_fresh_row_has_forgotten(policy):
    hidden, state, image = observe(0, 4)
    fresh = np.array([True, False, True, False])
    with_memory, _ = policy.act(hidden, state, image, fresh)
    without, _ = policy.act(policy.start(4), state, image, np.zeros(4, bool))
    assert (with_memory[fresh] == without[fresh]).all()
    assert (with_memory[~fresh] != without[~fresh]).all()


def test_the_answers_have_the_shapes_promised(policy):
    hidden, state, image = observe(0, 3)
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
    _, state, image = observe(0, 20)
    none = np.zeros(20, bool)
    action, _ = policy.act(policy.start(20), state, image, none)
    turned, _ = policy.act(policy.start(20), state[::-1], image[::-1], none)
    assert action[::-1].tobytes() == turned.tobytes()


def test_for_one_vehicle_a_row_goes_alone_and_its_answer_is_that_of_the_block(policy):
    hidden, state, image = observe(1, 1)
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
