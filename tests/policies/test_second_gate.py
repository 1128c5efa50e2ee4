"""A policy that sees the gate after the next as well: 15 numbers in every form it takes."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from policies import network
from policies.errors import PolicyError
from policies.export import export_policy
from policies.observation import state_vector
from policies.policy import load_policy
from policies.policy_file import save_policy
from policies.spec import PolicySpec
from policies.spec_json import spec_from_json, spec_to_json
from tests.policies.conftest import SPEC

SECOND = replace(SPEC, second_gate=True)
SCALE = {"action.weight": 2000.0, "state.bias": 5.0}


@pytest.fixture(scope="module")
def lively():
    made = network.init(jax.random.key(3), SECOND)
    return {k: np.asarray(v) * SCALE.get(k, 1.0) for k, v in made.items()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory, lively):
    return save_policy(tmp_path_factory.mktemp("second") / "second", lively, SECOND, seed=1)


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
    assert SECOND.state_size == 15


def test_the_last_three_numbers_are_the_second_gate_in_body_axes():
    """Worked with scipy: R^T (p - x); the first twelve are as without it."""
    turn = Rotation.from_euler("ZYX", [0.7, -0.3, 0.2])
    rng = np.random.default_rng(0)
    pos, vel, gate, last, second = rng.normal(size=(5, 3))
    without = state_vector(pos, vel, turn.as_matrix(), gate, last)
    seen = state_vector(pos, vel, turn.as_matrix(), gate, last, second)
    assert without.shape == (12,)
    np.testing.assert_array_equal(seen[:12], without)
    np.testing.assert_allclose(seen[12:], turn.inv().apply(second - pos), atol=1e-12)


def test_checkpoint_torch_and_onnx_are_one_policy(tmp_path, folder):
    ours = load_policy(folder)
    assert ours.spec == SECOND
    expected = actions(ours, 15)
    assert np.abs(expected).std() > 1.0
    for path in export_policy(folder, tmp_path):
        theirs = load_policy(path)
        assert theirs.spec == SECOND
        np.testing.assert_allclose(actions(theirs, 15), expected, atol=5e-5, rtol=1e-5)


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
    del stored["second_gate"]
    assert spec_from_json(stored, "here") == SPEC


@pytest.mark.parametrize("value", [1, "yes", None])
def test_the_key_is_true_or_false(value):
    stored = json.loads(json.dumps({**spec_to_json(SPEC), "second_gate": value}))
    with pytest.raises(PolicyError, match=r"second_gate is .*expected true or false"):
        spec_from_json(stored, "here")


def test_weights_of_another_state_are_refused(tmp_path, lively):
    save_policy(tmp_path / "torn", lively, SPEC, seed=1)
    with pytest.raises(PolicyError, match=r"state\.weight"):
        load_policy(tmp_path / "torn")


def test_a_policy_of_one_gate_goes_on_as_one_of_two(params):
    """It acts as before, whatever the second gate is; the other way round is refused."""
    rng = np.random.default_rng(0)
    wide = network.fitted(params, SECOND)
    state, image, hidden = (
        jnp.asarray(rng.normal(size=(4, *s)), jnp.float32) for s in ((15,), (24, 32), (64,))
    )
    before = network.step(params, hidden, state[:, :12], image)
    for a, b in zip(before, network.step(wide, hidden, state, image), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4, rtol=1e-5)
    with pytest.raises(ValueError, match=r"sees 15 numbers.*spec\.second_gate=True"):
        network.fitted(wide, SPEC)
