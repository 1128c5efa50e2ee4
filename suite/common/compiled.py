"""Where compiled programs are kept from one command to the next.

XLA takes 15 s over the model of a diagnosis and longer over a trainer; a second call of the same
command reads what the first one compiled.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, MutableMapping
from pathlib import Path

FOLDER = "diffracing-suite"
"""Of our own in the user's cache."""


def keep_compiled(environment: MutableMapping[str, str] | None = None) -> None:
    """Have JAX keep compiled programs in the user's cache, where nothing else was asked for.

    JAX reads its settings when it is imported: call this before.

    Args:
        environment: changed in place; that of this process if not given. An
            JAX_COMPILATION_CACHE_DIR that is there, also an empty one, is left as it is.
    """
    values = os.environ if environment is None else environment
    # A home that machines share must not hand one's instructions to another.
    folder = home(values) / "jax" / (platform.node() or "here")
    values.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))
    # XLA complains of its own tuning hints, which are no processor feature, at every program that
    # it loads; what goes wrong in earnest is raised as an exception.
    values.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def home(environment: Mapping[str, str] | None = None) -> Path:
    """Return our own folder in the user's cache."""
    values = os.environ if environment is None else environment
    return Path(values.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")) / FOLDER
