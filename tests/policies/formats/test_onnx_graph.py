"""The ONNX graph, run by ONNX's own reference operators and not by the runtime that flies it."""

import jax.numpy as jnp
import numpy as np
from onnx.reference import ReferenceEvaluator

from policies.formats.onnx_graph import IR_VERSION, OPSET, onnx_model
from policies.networks import network
from tests.policies.conftest import SPEC


def test_the_graph_is_our_network(params):
    model = onnx_model(params, SPEC, {"key": "text"})
    rng = np.random.default_rng(0)
    state, image, hidden = (
        rng.normal(size=(3, *shape)).astype(np.float32) for shape in ((12,), (24, 32), (64,))
    )
    ours = network.step(params, *map(jnp.asarray, (hidden, state, image)))
    feed = {"state": state, "image": image, "hidden": hidden}
    theirs = ReferenceEvaluator(model).run(None, feed)
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, np.asarray(b), atol=2e-5, rtol=1e-5)


def test_it_asks_for_old_standard_operators_only_and_carries_its_texts(params):
    model = onnx_model(params, SPEC, {"key": "text"})
    assert model.ir_version == IR_VERSION <= 8
    assert [(o.domain, o.version) for o in model.opset_import] == [("", OPSET)] and OPSET <= 17
    assert {node.domain for node in model.graph.node} == {""}
    assert [(p.key, p.value) for p in model.metadata_props] == [("key", "text")]
