"""Two short published flights of a real quadrotor, without their time on the ground.

README.md next to this file states their source, licence and changes; every copy has it.
"""

from __future__ import annotations

import lzma
from importlib.resources import files

MAPPING = "nanobench.toml"
"""File of `eval/importers/mappings` that imports the logs."""
ENDINGS = (".csv.xz", ".yaml", ".md", "LICENSE")
"""Endings of the files to copy."""


def real_files() -> dict[str, bytes]:
    """Return the logs, their mapping and their licence, uncompressed, by file name."""
    contents = {MAPPING: files("eval.importers.mappings").joinpath(MAPPING).read_bytes()}
    for source in files(__name__).iterdir():
        if source.name.endswith(ENDINGS):
            data = source.read_bytes()
            is_packed = source.name.endswith(".xz")
            contents[source.name.removesuffix(".xz")] = lzma.decompress(data) if is_packed else data
    return contents
