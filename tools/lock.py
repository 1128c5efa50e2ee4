"""Print requirements.lock: what pyproject.toml asks for, at the versions installed here.

Run by `make lock`. Only the project's requirements, its dev extra and what those need are
locked. Local version suffixes are dropped, so that the lock resolves against any package index.
"""

from __future__ import annotations

import importlib.metadata as metadata
import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

HEADER = """\
# Exact versions for `make env`, written by `make lock`. Python 3.11 to 3.13.
# The GPU libraries of torch's Linux builds are pinned by torch itself.
"""


def closure(requirements: list[str]) -> dict[str, str]:
    """Return name -> installed public version of `requirements` and all they need.

    Raises:
        ValueError: where something needed is not installed, or not at an allowed version.
    """
    found: dict[str, str] = {}
    seen: set[tuple[str, str]] = set()
    todo = [(Requirement(text), "") for text in requirements]
    while todo:
        wanted, extra = todo.pop()
        if wanted.marker and not wanted.marker.evaluate({"extra": extra}):
            continue
        name = canonicalize_name(wanted.name)
        try:
            package = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            raise ValueError(f"{wanted} is not installed: run make env first") from None
        if not wanted.specifier.contains(package.version, prereleases=True):
            raise ValueError(f"{name} {package.version} is installed, {wanted} is asked for")
        found[name] = Version(package.version).public
        for chosen in ["", *wanted.extras]:
            if (name, chosen) not in seen:
                seen.add((name, chosen))
                todo += [(Requirement(text), chosen) for text in package.requires or []]
    return found


def main() -> None:
    """Print the lock of the checkout that this script is in."""
    root = Path(__file__).resolve().parent.parent
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = project["dependencies"] + project["optional-dependencies"]["dev"]
    print(HEADER, end="")
    for name, version in sorted(closure(wanted).items()):
        print(f"{name}=={version}")


if __name__ == "__main__":
    main()
