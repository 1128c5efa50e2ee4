"""Policies that see more than the paper's twelve numbers, in every form they take."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from policies.errors import PolicyError
from policies.formats.export import export_policy
from policies.formats.policy_file import save_policy
from policies.formats.spec_json import spec_from_json, spec_to_json
from policies.networks import network
from policies.observation import View, observe
from policies.policy import load_policy
from policies.spec import PolicySpec
from tests.policies.conftest import SPEC, lively

SECOND = replace(SPEC, second_gate=True)
AXIS = replace(SPEC, gate_axis=True)
BOTH = replace(SECOND, gate_axis=True)


@pytest.fixture(scope="module")
def second():
    return lively(SECOND, 3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, second):
    return save_policy(tmp_path_factory.mktemp("second") / "second", second, SECOND, seed=1)


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    return save_policy(tmp_path_factory.mktemp("both") / "both", lively(BOTH, 4), BOTH, seed=1)


def state_of(spec, pos_w, vel_w, rot_w, gate_w, last_b, second_w, axis_w):
    return observe(spec, View(pos_w, rot_w, vel_w, gate_w, second_w, axis_w), last_b).state


def actions(policy, width, n=70, steps=5):
    rng = np.random.default_rng(7)
    hidden, found = policy.start(n), []
    for _ in range(steps):
        state = rng.normal(size=(n, width)).astype(np.float32)
        image = rng.uniform(-0.3, 9.4, (n, 24, 32)).astype(np.float32)
        action, hidden = policy.act(hidden, state, image, np.zeros(n, bool))
        found.append(action)
    return np.stack(found)


def test_the_paper_sees_one_gate_unless_asked():
    assert not PolicySpec().second_gate and PolicySpec().state_size == 12
    assert not PolicySpec().gate_axis
    assert SECOND.state_size == AXIS.state_size == 15 and BOTH.state_size == 18


def test_the_last_three_numbers_are_the_second_gate_in_body_axes():
    """Worked with scipy: R^T (p - x); the first twelve are as without it."""
    turn = Rotation.from_euler("ZYX", [0.7, -0.3, 0.2])
    rng = np.random.default_rng(0)
    pos, vel, gate, last, second = rng.normal(size=(5, 3))
    known = pos, vel, turn.as_matrix(), gate, last, second, np.array([1.0, 0.0, 0.0])
    without, seen = state_of(PolicySpec(), *known), state_of(SECOND, *known)
    assert without.shape == (12,)
    np.testing.assert_array_equal(seen[:12], without)
    np.testing.assert_allclose(seen[12:], turn.inv().apply(second - pos), atol=1e-12)


def test_the_gates_direction_comes_last_and_turns_with_the_body():
    """Worked with scipy: R^T e, whatever the position; alone it stands after the twelve."""
    turn = Rotation.from_euler("ZYX", [0.7, -0.3, 0.2])
    rng = np.random.default_rng(0)
    pos, vel, gate, last, second = rng.normal(size=(5, 3))
    axis = np.array([0.6, -0.8, 0.0])
    body = turn.as_matrix()
    known = vel, body, gate, last, second, axis
    with_both = state_of(BOTH, pos, *known)
    np.testing.assert_array_equal(with_both[:15], state_of(SECOND, pos, *known))
    np.testing.assert_allclose(with_both[15:], turn.inv().apply(axis), atol=1e-12)
    alone = state_of(AXIS, pos + 5, *known)
    np.testing.assert_array_equal(alone[12:], with_both[15:])


@pytest.mark.parametrize(("kind", "spec"), [("folder", SECOND), ("both", BOTH)])
def test_checkpoint_torch_and_onnx_are_one_policy(tmp_path, kind, spec, request):
    folder = request.getfixturevalue(kind)
    ours = load_policy(folder)
    assert ours.spec == spec
    expected = actions(ours, spec.state_size)
    assert np.abs(expected).std() > 1.0
    for path in export_policy(folder, tmp_path):
        theirs = load_policy(path, trust=True)
        assert theirs.spec == spec
        np.testing.assert_allclose(actions(theirs, spec.state_size), expected, atol=5e-5, rtol=1e-5)


def test_the_second_gate_matters_to_it(folder):
    policy, rng = load_policy(folder), np.random.default_rng(0)
    state = rng.normal(size=(1, 15)).astype(np.float32)
    image, fresh = np.zeros((1, 24, 32), np.float32), np.ones(1, bool)
    other = state.copy()
    other[:, 12:] += 1.0
    one, two = (policy.act(policy.start(1), s, image, fresh)[0] for s in (state, other))
    assert np.abs(one - two).max() > 1e-2


def test_a_checkpoint_without_the_key_sees_one_gate():
    stored = spec_to_json(SPEC)
    del stored["second_gate"], stored["gate_axis"]
    assert spec_from_json(stored, "here") == SPEC


@pytest.mark.parametrize("value", [1, "yes", None])
def test_the_key_is_true_or_false(value):
    stored = json.loads(json.dumps({**spec_to_json(SPEC), "second_gate": value}))
    with pytest.raises(PolicyError, match=r"second_gate is .*expected true or false"):
        spec_from_json(stored, "here")


def test_weights_of_another_state_are_refused(tmp_path, second):
    save_policy(tmp_path / "torn", second, SPEC, seed=1)
    with pytest.raises(PolicyError, match=r"state\.weight"):
        load_policy(tmp_path / "torn")


@pytest.mark.parametrize(
    ("seen", "spec", "columns"),
    [
        (SPEC, SECOND, slice(0, 12)),
        (SPEC, BOTH, slice(0, 12)),
        (SECOND, BOTH, slice(0, 15)),
        (AXIS, BOTH, np.r_[0:12, 15:18]),
    ],
)
def test_a_policy_goes_on_as_one_that_sees_more(seen, spec, columns):
    """It acts as before, whatever the new numbers are."""
    rng = np.random.default_rng(0)
    params = network.init(jax.random.key(5), seen)
    wide = network.fitted(params, seen, spec)
    state, image, hidden = (
        jnp.asarray(rng.normal(size=(4, *s)), jnp.float32)
        for s in ((spec.state_size,), (24, 32), (64,))
    )
    before = network.step(params, hidden, state[:, columns], image)
    for a, b in zip(before, network.step(wide, hidden, state, image), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize(
    ("seen", "spec", "key"),
    [(SECOND, SPEC, "second_gate"), (AXIS, SECOND, "gate_axis"), (BOTH, AXIS, "second_gate")],
)
def test_a_policy_that_sees_more_is_refused(seen, spec, key):
    params = network.init(jax.random.key(5), seen)
    with pytest.raises(ValueError, match=rf"has spec\.{key}; set spec\.{key}=True"):
        network.fitted(params, seen, spec)


def test_a_policy_of_another_size_or_rate_is_refused():
    params = network.init(jax.random.key(5), SPEC)
    for changed, words in (({"hidden_size": 32}, "hidden_size 64, and this run 32"),
                           ({"rate_hz": 60.0}, "rate_hz .*, and this run 60.0")):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            network.fitted(params, SPEC, replace(SPEC, **changed))
