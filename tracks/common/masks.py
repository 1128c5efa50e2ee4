"""Rows of nested arrays chosen by a mask, and laid out; what a mask makes needless is left out.

It is left out of numpy's steps, and of no program that JAX compiles:
A traced mask holds nothing yet, and a compiled program is the same whatever it holds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tracks.geometry.scene import Array


def everywhere(mask: Array) -> bool:
    """Return whether a numpy `mask` is known to hold in all rows; False of one of JAX."""
    return isinstance(mask, np.ndarray) and bool(mask.all())


def nowhere(mask: Array) -> bool:
    """Return whether a numpy `mask` is known to hold in no row; False of one of JAX."""
    return isinstance(mask, np.ndarray) and not mask.any()


def select(mask: Array, new: Any, old: Any) -> Any:
    """Return `new` in the rows where `mask` (N,) and `old` elsewhere.

    Both are arrays (N, ...), or alike nested tuples and dicts of such; None stays None.
    """
    if everywhere(mask):
        return new
    return _selected(mask, new, old)


def _selected(mask: Array, new: Any, old: Any) -> Any:
    if isinstance(new, dict):
        return {name: _selected(mask, new[name], old[name]) for name in new}
    if isinstance(new, tuple):
        parts = [_selected(mask, a, b) for a, b in zip(new, old, strict=True)]
        return type(new)(*parts) if hasattr(new, "_fields") else tuple(parts)
    if new is None:
        return None
    xp = mask.__array_namespace__()
    return xp.where(mask.reshape(mask.shape + (1,) * (new.ndim - 1)), new, old)


def packed(tree: Any) -> Any:
    """Return nested tuples and dicts of numpy arrays with every array laid out row by row.

    numpy adds up in an order that depends on how an array lies in memory, and a concatenation
    lies as its parts do; without this a row's last bit could depend on the rows beside it.
    Arrays of JAX have one layout and are passed on.
    """
    return _mapped(lambda x: np.ascontiguousarray(x) if isinstance(x, np.ndarray) else x, tree)


def take(tree: Any, rows: Any) -> Any:
    """Return an array, or nested tuples and dicts of such, indexed with `rows`."""
    return _mapped(lambda x: x[rows], tree)


def _mapped(function: Callable[[Any], Any], tree: Any) -> Any:
    if isinstance(tree, dict):
        return {name: _mapped(function, part) for name, part in tree.items()}
    if isinstance(tree, tuple):
        parts = [_mapped(function, part) for part in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    return function(tree)
