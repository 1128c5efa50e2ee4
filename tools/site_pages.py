"""What `make docs` changes: links that lead out of docs/, pages from the root, and the search.

On a page read in the repository such a link opens a file. The site holds no such files, so their
path within the repository stands there instead. A link to a file that does not exist ends the
build. CONTRIBUTING.md and CHANGELOG.md become pages, so that the navigation has them. The search
leaves out docs/archive, whose pages are of removed policies and experiments.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = {"contributing.md": "CONTRIBUTING.md", "releases.md": "CHANGELOG.md"}
"""Page of the site -> file of the repository's root."""
OUTSIDE = re.compile(r"(?<!!)\[([^\]]*)\]\(((?:\.\./)+[^)#\s]+)(?:#[^)]*)?\)")
"""A link, not a picture, that climbs at least one folder."""


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Return a page's text with links out of docs/ as paths within the repository."""
    docs = Path(config["docs_dir"]).resolve()
    here = (docs / page.file.src_uri).parent

    def named(match: re.Match[str]) -> str:
        text, target = match[1], (here / match[2]).resolve()
        if target.is_relative_to(docs):
            return match[0]
        if not target.exists():
            raise FileNotFoundError(f"{page.file.src_uri}: links to {match[2]}, which is not there")
        path = f"`{target.relative_to(docs.parent)}`"
        return path if text.strip("`") in (target.name, path.strip("`")) else f"{text} ({path})"

    return OUTSIDE.sub(named, markdown)


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of `ROOT`, with links as they are within docs/."""
    root = Path(config["docs_dir"]).resolve().parent
    for page, name in ROOT.items():
        text = (root / name).read_text(encoding="utf-8")
        links = re.sub(r"\]\((?!\w+:)(?!docs/)", "](../", text).replace("](docs/", "](")
        files.append(File.generated(config, page, content=links))
    return files


def on_post_build(config: Any, **_: Any) -> None:
    """Take the pages of docs/archive out of the search."""
    path = Path(config["site_dir"], "search", "search_index.json")
    index = json.loads(path.read_text(encoding="utf-8"))
    index["docs"] = [one for one in index["docs"] if not one["location"].startswith("archive/")]
    path.write_text(json.dumps(index), encoding="utf-8")
