"""Bake the git commit into a built wheel, which has no repository to ask later."""

import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

sys.path.insert(0, str(Path(__file__).resolve().parent))

from tracks.common.provenance import git_commit  # noqa: E402  (the build does not run in this folder)


class BuildWithCommit(build_py):
    """The usual build, plus the file that `provenance.git_commit` reads in a wheel."""

    def run(self) -> None:
        """Build, then write the commit beside tracks/common/provenance.py."""
        super().run()
        if not self.editable_mode:
            target = Path(self.build_lib, "tracks", "common", "built_from.txt")
            target.write_text((git_commit() or "") + "\n", encoding="utf-8")


setup(cmdclass={"build_py": BuildWithCommit})
