"""Convert a JAX pytree (parameters, optimiser state, random key) to arrays by name, and back.

Also convert the policy network's weights to the layouts of torch and ONNX, in which rows are
outputs and channels come first.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from policies.spec import PolicyError, PolicySpec


def tree_to_arrays(tree: Any) -> dict[str, np.ndarray]:
    """Return the leaves of `tree` by their path; random keys are replaced by their data."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path): np.asarray(_data(leaf)) for path, leaf in leaves}


def tree_from_arrays(template: Any, arrays: Mapping[str, np.ndarray], where: str) -> Any:
    """Return a tree with the structure of `template` from the result of `tree_to_arrays`.

    Structure, shapes and types of `template` are required; its values are not used.

    Raises:
        PolicyError: where the names, a shape or a type differ from the template's.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(template)
    names = [jax.tree_util.keystr(path) for path, _ in leaves]
    if arrays.keys() != set(names):
        missing, unknown = sorted(set(names) - arrays.keys()), sorted(arrays.keys() - set(names))
        raise PolicyError(
            f"{where}: missing arrays {missing[:5]}, unknown arrays {unknown[:5]}; "
            "resume with the configuration that the run was started with"
        )
    restored = []
    for name, (_, leaf) in zip(names, leaves, strict=True):
        value, expected = arrays[name], np.asarray(_data(leaf))
        if value.shape != expected.shape or value.dtype != expected.dtype:
            raise PolicyError(
                f"{where}: {name!r} is {value.dtype} {value.shape}, expected {expected.dtype} "
                f"{expected.shape}; resume with the configuration that the run was started with"
            )
        array = jnp.asarray(value)
        if _is_key(leaf):
            array = jax.random.wrap_key_data(array, impl=jax.random.key_impl(leaf))
        restored.append(array)
    return jax.tree_util.tree_unflatten(structure, restored)


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _data(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def rows_are_outputs(weight: np.ndarray) -> np.ndarray:
    """Return a matrix (inputs, outputs) as (outputs, inputs), C-contiguous float32."""
    return np.array(np.asarray(weight).T, np.float32, order="C")


def kernel_oihw(kernel: np.ndarray) -> np.ndarray:
    """Return a kernel (h, w, inputs, outputs) as (outputs, inputs, h, w), C-contiguous float32."""
    return np.array(np.asarray(kernel).transpose(3, 2, 0, 1), np.float32, order="C")


def image_weight(params: Mapping[str, np.ndarray], spec: PolicySpec) -> np.ndarray:
    """Return the weights (hidden, features) of the image's embedding.

    The features are in the order of torch and ONNX, channels first.
    """
    rows, columns = spec.camera.height // 4 - 4, spec.camera.width // 4 - 4
    weight = np.asarray(params["image.weight"]).reshape(rows, columns, spec.channels[2], -1)
    return rows_are_outputs(weight.transpose(2, 0, 1, 3).reshape(-1, weight.shape[-1]))
