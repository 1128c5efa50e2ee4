"""Two short flights of a real quadrotor as its laboratory published them, cut to the flight.

Their source, licence and what was cut: README.md next to this file, which is part of every copy.
"""

from __future__ import annotations

import lzma
from importlib.resources import files

MAPPING = "nanobench.toml"
"""Of `eval/importers/mappings`; it goes with the logs."""
KEPT = (".csv.xz", ".yaml", ".md", "LICENSE")


def real_files() -> dict[str, bytes]:
    """Return the logs with what belongs to them, unpacked, by name."""
    found = {}
    for source in files(__name__).iterdir():
        if source.name.endswith(KEPT):
            packed = source.name.endswith(".xz")
            whole = lzma.decompress(source.read_bytes()) if packed else source.read_bytes()
            found[source.name.removesuffix(".xz")] = whole
    shipped = files("eval.importers.mappings")
    return found | {MAPPING: shipped.joinpath(MAPPING).read_bytes()}
