"""Write a result page: NAME.md with its tables, NAME.png with its charts, NAME.json with numbers.

In NAME.md the generated part is between two comments, with hand-written text around it.
`suite reproduce` replaces only the generated part, so a page can be made again without losing text.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from suite.common.console import Console
from suite.common.provenance import machine, package_versions
from suite.common.report import Picture
from suite.experiments import EXPERIMENTS
from suite.experiments.study.cache import Workspace, page_code
from tracks.common.files import plain, replacing_file, write_json, write_text
from tracks.common.grid import Grid, markdown
from tracks.common.provenance import stamp

SCHEMA = 1
"""Version of NAME.json."""
BEGIN, END = "<!-- made by suite reproduce -->", "<!-- end of what suite reproduce made -->"
"""The lines around the generated part."""


class PageContents(NamedTuple):
    """The results of an experiment."""

    facts: Mapping[str, str]
    """How the results were made, by name: policies, recipe, trials, seeds."""
    parts: Mapping[str, Sequence[Grid | Picture]]
    """Heading -> tables and charts below it."""
    numbers: Mapping[str, Any]
    """Contents of NAME.json, without configuration and provenance."""


def check_page(out: Path, name: str) -> None:
    """Refuse a page that cannot be made again without losing text.

    Raises:
        ValueError: if `out` has a NAME.md without the two comments.
    """
    path = out / f"{name}.md"
    if path.is_file():
        _split_page(path.read_text(encoding="utf-8"), path)


def write_document(
    workspace: Workspace,
    name: str,
    config: Any,
    contents: PageContents,
    words: Sequence[str],
    console: Console,
) -> dict[str, Any]:
    """Write the charts `name`.png, `name`-2.png, ..., `name`.json and `name`.md to `workspace.out`.

    The page is written last, after everything that it shows. The `seed` of `config` goes into the
    stamp (version, commit, seed), and `words`, those of the command, into the facts.

    Returns:
        The contents of `name`.json, and `out`, the page's path.

    Raises:
        ValueError: if the existing page lacks the two comments.
        OSError: if a file cannot be written.
    """
    header, page = stamp(SCHEMA, config.seed), workspace.out / f"{name}.md"
    facts = {**contents.facts, **_provenance(header, words)}
    # A new page has a title, a summary and an empty generated part.
    summary = EXPERIMENTS.get(name, name)
    new_page = f"# {name}\n\n{summary[0].upper()}{summary[1:]}.\n\n{BEGIN}\n{END}\n"
    old_page = page.read_text(encoding="utf-8") if page.is_file() else new_page
    before, after = _split_page(old_page, page)
    header["code_sha256"] = page_code(name)
    answer = {**header, "made_by": facts, "config": config, **contents.numbers}
    # Text of the page, and the charts as files; the first chart has no number in its name.
    figures: list[str] = []
    blocks = ["\n".join(f"- {key}: {value}" for key, value in facts.items())]
    for title, parts in contents.parts.items():
        blocks.append(f"## {title}")
        for part in parts:
            if isinstance(part, Grid):
                blocks.append(markdown(part).strip("\n"))
                continue
            file = f"{name}.png" if not figures else f"{name}-{len(figures) + 1}.png"
            figures.append(file)
            with replacing_file(workspace.out / file) as new_file:
                new_file.write_bytes(part.png)
            blocks.append(f"![{part.caption}]({file})")
    write_json(workspace.out / f"{name}.json", answer)
    write_text(page, "\n\n".join([before + BEGIN, *blocks, END]) + after)
    console.say(f"written: {page}, {name}.json" + "".join(f", {file}" for file in figures))
    return {**plain(answer), "out": str(page)}


def _split_page(text: str, path: Path) -> tuple[str, str]:
    """Return the hand-written text before and after the generated part of a page."""
    before, begin, remainder = text.partition(BEGIN)
    _, end, after = remainder.partition(END)
    if not begin or not end:
        raise ValueError(
            f"{path}: has no {END if begin else BEGIN}, so its text would be lost; move it away, "
            f"or add the lines {BEGIN} and {END} around the part to replace"
        )
    return before, after


def _provenance(header: Mapping[str, Any], words: Sequence[str]) -> dict[str, str]:
    """Return command, commit, machine and engines, for the facts of a page."""
    computer = machine()
    engines = (f"{key} {package_versions()[key]}" for key in ("mujoco", "jax", "numpy"))
    return {
        "command": f"`{shlex.join(['suite', *words[1:]])}`",
        "commit": f"{header['git_commit']}, version {header['suite_version']}",
        "machine": f"{computer['processor']}, {computer['cores']} cores; {', '.join(engines)}",
    }
