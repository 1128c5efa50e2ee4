"""Programs of tools/ and examples/ as modules, and projects as wheels."""

import importlib.util
import subprocess
import sys


def program(path):
    """Return a Python file as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def built_wheel(source, folder):
    """Build the wheel of the project in `source` as pip does, without pip's own processes."""
    code = "import sys, setuptools.build_meta as build; print(build.build_wheel(sys.argv[1]))"
    command = [sys.executable, "-c", code, str(folder)]
    done = subprocess.run(command, cwd=source, check=True, capture_output=True, text=True)
    return folder / done.stdout.split()[-1]
