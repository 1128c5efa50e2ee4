"""Programs of tools/ and examples/ as modules, and projects as wheels."""

import importlib.util
import subprocess
import sys

BLOCKER = """
import json, sys
blocked = set()
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in blocked:
            raise ImportError(f"{name} is blocked")
sys.meta_path.insert(0, Blocker())
"""
"""The start of a program in which packages cannot be imported whose names are in `blocked`."""


def program(path):
    """Return a Python file as a module."""
    spec = importlib.util.spec_from_file_location(f"program_{path.stem}", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up there.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def python(code, *arguments, **options):
    """Run a program in a process of its own; return the finished process with its output."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, **options)


def built_wheel(source, folder):
    """Build the wheel of the project in `source` as pip does, without pip's own processes."""
    code = "import sys, setuptools.build_meta as build; print(build.build_wheel(sys.argv[1]))"
    done = python(code, folder, cwd=source, check=True)
    return folder / done.stdout.split()[-1]
