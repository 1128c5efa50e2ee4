"""docs/modules.md says of every module what its docstring says."""

import importlib.util


def test_the_page_of_modules_is_what_the_code_says(root):
    spec = importlib.util.spec_from_file_location("modules", root / "tools" / "modules.py")
    assert spec and spec.loader
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    written = (root / "docs" / "modules.md").read_text(encoding="utf-8")
    assert written == tool.page(), "run: python tools/modules.py"
