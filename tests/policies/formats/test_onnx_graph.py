"""The ONNX graph, run by ONNX's own reference operators, and the twin in torch: our network."""

import jax.numpy as jnp
import numpy as np
import torch
from onnx.reference import ReferenceEvaluator

from policies.formats.onnx_graph import IR_VERSION, OPSET, onnx_model
from policies.formats.torch_twin import torch_twin
from policies.networks import network
from tests.policies.conftest import SPEC


def test_the_graph_and_the_twin_are_our_network(params):
    rng = np.random.default_rng(0)
    state, image, hidden = (
        rng.normal(size=(3, *shape)).astype(np.float32) for shape in ((12,), (24, 32), (64,))
    )
    ours = network.step(params, *map(jnp.asarray, (hidden, state, image)))
    feed = {"state": state, "image": image, "hidden": hidden}
    graph = ReferenceEvaluator(onnx_model(params, SPEC, {"key": "text"})).run(None, feed)
    with torch.no_grad():
        twin = torch_twin(params, SPEC)(*map(torch.from_numpy, (state, image, hidden)))
    for theirs in (graph, twin):
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(a, np.asarray(b), atol=2e-5, rtol=1e-5)


def test_it_asks_for_old_standard_operators_only_and_carries_its_texts(params):
    model = onnx_model(params, SPEC, {"key": "text"})
    assert model.ir_version == IR_VERSION <= 8
    assert [(o.domain, o.version) for o in model.opset_import] == [("", OPSET)] and OPSET <= 17
    assert {node.domain for node in model.graph.node} == {""}
    assert [(p.key, p.value) for p in model.metadata_props] == [("key", "text")]
