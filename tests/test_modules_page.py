"""docs/modules.md says of every module what its docstring says."""

from tests.support.tools import tool


def test_the_page_of_modules_is_what_the_code_says(root):
    written = (root / "docs" / "modules.md").read_text(encoding="utf-8")
    assert written == tool(root, "modules").page(), "run: python tools/modules.py"
