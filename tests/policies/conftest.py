"""A policy with actions of the size that racing has, saved and exported once for all tests."""

import jax
import numpy as np
import pytest

from policies.formats.export import export_policy
from policies.formats.policy_file import save_policy
from policies.networks import network
from policies.spec import PolicySpec
from tracks.geometry.camera import Camera

SPEC = PolicySpec(rate_hz=33.0, camera=Camera(pitch_deg=20.0), hidden_size=64)


def lively(spec, seed):
    """Return fresh parameters whose actions are of the size that racing has."""
    scale = {"action.weight": 20.0, "state.bias": 5.0}
    made = network.init(jax.random.key(seed), spec)
    return {name: np.asarray(value) * scale.get(name, 1.0) for name, value in made.items()}


@pytest.fixture(scope="session")
def params():
    return lively(SPEC, 2)


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory, params):
    return save_policy(tmp_path_factory.mktemp("policy") / "tiny", params, SPEC, seed=1)


@pytest.fixture(scope="session")
def exported(tmp_path_factory, checkpoint):
    """The folder with tiny.pt2 and tiny.onnx."""
    folder = tmp_path_factory.mktemp("exported")
    export_policy(checkpoint, folder)
    return folder
