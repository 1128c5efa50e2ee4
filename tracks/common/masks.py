"""Select rows of arrays, and of nested tuples and dicts of arrays, by a mask (numpy and JAX).

With numpy, callers skip work where a mask is true or false everywhere. JAX traces masks without
values, so a compiled program always does all the work.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tracks.geometry.scene import Array


def everywhere(mask: Array) -> bool:
    """Return whether a numpy `mask` is true in all rows; always False for JAX."""
    return isinstance(mask, np.ndarray) and bool(mask.all())


def nowhere(mask: Array) -> bool:
    """Return whether a numpy `mask` is false in all rows; always False for JAX."""
    return isinstance(mask, np.ndarray) and not mask.any()


def select(mask: Array, new: Any, old: Any) -> Any:
    """Return `new` in the rows where `mask` (N,) and `old` elsewhere.

    Both are arrays (N, ...), or equally nested tuples and dicts of arrays; None is kept.
    """
    if everywhere(mask):
        return new
    return _selected(mask, new, old)


def _selected(mask: Array, new: Any, old: Any) -> Any:
    """Return the result of `select`, without its shortcut for a mask that is true everywhere."""
    if isinstance(new, dict):
        return {name: _selected(mask, new[name], old[name]) for name in new}
    if isinstance(new, tuple):
        parts = [_selected(mask, a, b) for a, b in zip(new, old, strict=True)]
        return type(new)(*parts) if hasattr(new, "_fields") else tuple(parts)
    if new is None:
        return None
    xp = mask.__array_namespace__()
    return xp.where(mask.reshape(mask.shape + (1,) * (new.ndim - 1)), new, old)


def make_contiguous(tree: Any) -> Any:
    """Return nested tuples and dicts of numpy arrays with all arrays C-contiguous.

    numpy's order of summation depends on the memory layout, and a concatenation inherits the layout
    of its parts. So without this function, the last bit of a row could depend on the other rows.
    JAX arrays have only one layout and are returned unchanged.
    """
    return _mapped(_contiguous, tree)


def take(tree: Any, rows: Any) -> Any:
    """Return an array, or nested tuples and dicts of arrays, indexed with `rows`."""
    return _mapped(lambda x: x[rows], tree)


def _contiguous(array: Array) -> Array:
    if isinstance(array, np.ndarray) and not array.flags.c_contiguous:
        return np.ascontiguousarray(array)
    return array


def _mapped(function: Callable[[Any], Any], tree: Any) -> Any:
    """Return nested tuples and dicts with `function` applied to each array."""
    if isinstance(tree, dict):
        return {name: _mapped(function, part) for name, part in tree.items()}
    if isinstance(tree, tuple):
        parts = [_mapped(function, part) for part in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    return function(tree)
