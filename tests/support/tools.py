"""Programs of tools/ as modules."""

import importlib.util


def tool(root, name):
    """Return tools/NAME.py as a module."""
    spec = importlib.util.spec_from_file_location(name, root / "tools" / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
