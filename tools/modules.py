"""Write docs/modules.md: every module with the first sentence of its docstring.

    python tools/modules.py

A test holds the page to the code.
"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "modules.md"
ROOMS = {
    "tracks": "what is flown through",
    "policies": "who flies",
    "eval": "the judge",
    "suite": "what a person runs",
}
HEAD = """# Modules

Every file of the four rooms in one sentence, from its docstring (`python tools/modules.py` writes this
page). [architecture.md](architecture.md) says how they belong together.
"""


def sentence(path: Path) -> str:
    """Return the first paragraph of a module's docstring on one line, without its full stop."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(text.split("\n\n")[0].split()).rstrip(".").replace("|", r"\|")


def page() -> str:
    """Return docs/modules.md as the code has it now."""
    parts = [HEAD]
    for room, what in ROOMS.items():
        parts.append(f"\n## {room}: {what}\n")
        folders = {path.parent for path in (ROOT / room).rglob("*.py")}
        for folder in sorted(folders):
            place = folder.relative_to(ROOT)
            parts.append(f"\n**`{place}/`** {sentence(folder / '__init__.py')}\n\n")
            files = [path for path in sorted(folder.glob("*.py")) if path.name != "__init__.py"]
            parts += [f"- `{path.name}`: {sentence(path)}\n" for path in files]
    return "".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
