"""Print requirements.lock: the installed version of each package that pyproject.toml requires.

`make lock` runs it. The lock has the requirements of the project and of its extra `dev`, and all
that these require in turn. Local parts of versions (`+cpu`) are removed, because other package
indexes do not have them.
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
"""Comment above the versions."""


def closure(requirements: list[str]) -> dict[str, str]:
    """Return package -> installed version, for `requirements` and all that they require in turn.

    Raises:
        ValueError: if a package is not installed, or not at an allowed version.
    """
    versions: dict[str, str] = {}
    visited: set[tuple[str, str]] = set()
    pending = [(Requirement(text), "") for text in requirements]
    while pending:
        requirement, extra = pending.pop()
        if requirement.marker and not requirement.marker.evaluate({"extra": extra}):
            continue
        name = canonicalize_name(requirement.name)
        try:
            package = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            raise ValueError(f"{requirement} is not installed: run make env first") from None
        if not requirement.specifier.contains(package.version, prereleases=True):
            raise ValueError(
                f"{name} {package.version} is installed, but {requirement} is required: "
                "run make env first"
            )
        versions[name] = Version(package.version).public
        for package_extra in ["", *requirement.extras]:
            if (name, package_extra) not in visited:
                visited.add((name, package_extra))
                pending += [(Requirement(text), package_extra) for text in package.requires or []]
    return versions


def lines(requirements: list[str]) -> list[str]:
    """Return the lock's lines. A package of marked requirements only has their marker."""
    markers: dict[str, str] = {}
    for text in sorted(requirements, key=lambda text: Requirement(text).marker is not None):
        marker = Requirement(text).marker
        for name in closure([text]):
            markers.setdefault(name, f"; {marker}" if marker else "")
    versions = closure(requirements)
    return [f"{name}=={version}{markers[name]}" for name, version in sorted(versions.items())]


def main() -> None:
    """Print the lock of the checkout that this script is in."""
    root = Path(__file__).resolve().parent.parent
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    requirements = project["dependencies"] + project["optional-dependencies"]["dev"]
    print(HEADER, end="")
    for line in lines(requirements):
        print(line)


if __name__ == "__main__":
    main()
