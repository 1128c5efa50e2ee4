"""Functions that mkdocs calls for `make docs`: for links out of docs/, two pages, and the search.

In the repository a link out of docs/ opens a file. The site has no such files, so the link is
replaced by the path of the file. A link to a file that does not exist ends the build.
CONTRIBUTING.md and CHANGELOG.md become pages of the site. The search excludes docs/archive, whose
pages describe removed policies and experiments.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = {"contributing.md": "CONTRIBUTING.md", "releases.md": "CHANGELOG.md"}
"""Page of the site -> file in the root folder of the repository."""
OUTSIDE = re.compile(r"(?<!!)\[([^\]]*)\]\(((?:\.\./)+[^)#\s]+)(?:#[^)]*)?\)")
"""A link, not a picture, whose path begins with at least one `../`."""


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Return the text of a page, with links out of docs/ replaced by paths in the repository.

    Raises:
        FileNotFoundError: for a link to a file that does not exist.
    """
    docs = Path(config["docs_dir"]).resolve()
    folder = (docs / page.file.src_uri).parent

    def as_path(match: re.Match[str]) -> str:
        """Return the text that replaces a link; a link within docs/ is kept."""
        text, target = match[1], (folder / match[2]).resolve()
        if target.is_relative_to(docs):
            return match[0]
        if not target.exists():
            reason = f"links to {match[2]}, which does not exist"
            raise FileNotFoundError(f"{page.file.src_uri}: {reason}")
        path = f"`{target.relative_to(docs.parent)}`"
        return path if text.strip("`") in (target.name, path.strip("`")) else f"{text} ({path})"

    return OUTSIDE.sub(as_path, markdown)


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of `ROOT`, with links that are relative to docs/."""
    root = Path(config["docs_dir"]).resolve().parent
    for page, name in ROOT.items():
        text = (root / name).read_text(encoding="utf-8")
        links = re.sub(r"\]\((?!\w+:)(?!docs/)", "](../", text).replace("](docs/", "](")
        files.append(File.generated(config, page, content=links))
    return files


def on_post_build(config: Any, **_: Any) -> None:
    """Remove the pages of docs/archive from the search index."""
    path = Path(config["site_dir"], "search", "search_index.json")
    index = json.loads(path.read_text(encoding="utf-8"))
    index["docs"] = [page for page in index["docs"] if not page["location"].startswith("archive/")]
    path.write_text(json.dumps(index), encoding="utf-8")
