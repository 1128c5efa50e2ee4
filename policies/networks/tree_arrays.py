"""Convert a JAX pytree (parameters, optimiser state) to arrays by name, and back.

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
    """Return the leaves of `tree` by their path."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


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
        value, expected = arrays[name], np.asarray(leaf)
        if value.shape != expected.shape or value.dtype != expected.dtype:
            raise PolicyError(
                f"{where}: {name!r} is {value.dtype} {value.shape}, expected {expected.dtype} "
                f"{expected.shape}; resume with the configuration that the run was started with"
            )
        restored.append(jnp.asarray(value))
    return jax.tree_util.tree_unflatten(structure, restored)


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
