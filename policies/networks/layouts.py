"""Our network's parameters in the layouts of torch and ONNX: rows are outputs, channels first."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from policies.spec import PolicySpec


def rows_are_outputs(weight: np.ndarray) -> np.ndarray:
    """Return a matrix (inputs, outputs) as (outputs, inputs), C-contiguous float32."""
    return np.array(np.asarray(weight).T, np.float32, order="C")


def kernel_oihw(kernel: np.ndarray) -> np.ndarray:
    """Return a kernel (h, w, inputs, outputs) as (outputs, inputs, h, w), C-contiguous float32."""
    return np.array(np.asarray(kernel).transpose(3, 2, 0, 1), np.float32, order="C")


def image_weight(params: Mapping[str, np.ndarray], spec: PolicySpec) -> np.ndarray:
    """Return the image's embedding (hidden, features) for features flattened channels first."""
    rows, columns = spec.camera.height // 4 - 4, spec.camera.width // 4 - 4
    weight = np.asarray(params["image.weight"]).reshape(rows, columns, spec.channels[2], -1)
    return rows_are_outputs(weight.transpose(2, 0, 1, 3).reshape(-1, weight.shape[-1]))
