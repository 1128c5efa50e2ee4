"""Our network as a policy: its checkpoint and its parameters fly alike, whatever the threads."""

import os
import subprocess
import sys
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from policies.native import load_native, native_policy
from policies.networks import network
from tests.policies.conftest import SPEC, lively

SECOND = replace(SPEC, second_gate=True)


def test_a_checkpoint_is_named_and_flies_as_its_parameters_do(checkpoint, params):
    loaded, made = load_native(checkpoint, "tiny"), native_policy(params, SPEC, "tiny")
    assert (loaded.name, loaded.spec, loaded.hidden_shape) == ("tiny", SPEC, (64,))
    rng = np.random.default_rng(0)
    state = rng.normal(size=(3, 12)).astype(np.float32)
    image = rng.uniform(-0.3, 9.4, (3, 24, 32)).astype(np.float32)
    fresh = np.ones(3, bool)
    answers = [policy.act(policy.start(3), state, image, fresh) for policy in (loaded, made)]
    for one, two in zip(*answers, strict=True):
        assert one.tobytes() == two.tobytes()
    expected, _ = network.step(params, *map(jnp.asarray, (made.start(3), state, image)))
    np.testing.assert_allclose(answers[0][0], expected, atol=1e-5, rtol=1e-5)


def test_the_second_gate_matters_to_it():
    policy, rng = native_policy(lively(SECOND, 3), SECOND, "second"), np.random.default_rng(0)
    state = rng.normal(size=(1, 15)).astype(np.float32)
    image, fresh = np.zeros((1, 24, 32), np.float32), np.ones(1, bool)
    other = state.copy()
    other[:, 12:] += 1.0
    one, two = (policy.act(policy.start(1), s, image, fresh)[0] for s in (state, other))
    assert np.abs(one - two).max() > 1e-2


def test_thread_counts_do_not_change_our_network(checkpoint, tmp_path):
    """XLA's pool may split the work any way; the bits have to stay."""
    script = (
        "import sys, hashlib, numpy as np\n"
        "from policies.policy import load_policy\n"
        "p, r = load_policy(sys.argv[1]), np.random.default_rng(0)\n"
        "s, i = r.normal(size=(64, 12)), r.normal(size=(64, 24, 32))\n"
        "a, h = p.act(p.start(64), s, i, np.ones(64, bool))\n"
        "print(hashlib.sha256(a.tobytes() + h.tobytes()).hexdigest(), p.rows)\n"
    )
    found = set()
    for flags in ("", "--xla_cpu_multi_thread_eigen=false"):
        environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
        command = [sys.executable, "-c", script, str(checkpoint)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        found.add(done.stdout)
    assert len(found) == 1 and found.pop().endswith(" 64\n")
