"""A result as a Markdown page with its figures beside it and its numbers as JSON."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from suite.common.console import Console
from suite.common.provenance import machine, package_versions
from suite.common.report import Details, Links, Part, Picture, Report
from tracks.common.files import plain, replacing_file, write_json, write_text
from tracks.common.grid import Grid, markdown
from tracks.common.provenance import stamp
from tracks.common.work import Workers

SCHEMA = 1
"""Version of NAME.json."""


@dataclass(frozen=True)
class Place:
    """Where an experiment's files go, and who works on it."""

    out: Path
    """Folder of the documents."""
    cache: Path
    """Folder of what was computed before, by any experiment."""
    workers: Workers | None = None
    """Who trains and flies; None trains one after the other, and flies in processes."""

    @property
    def at_once(self) -> str:
        """Trainings at once, in words."""
        if isinstance(self.workers, str):
            return "as many as the cluster has workers"
        if self.workers in (None, 1):
            return "1, on all cores"
        return f"{self.workers}, each on its own share of the cores"


def write_document(
    place: Place,
    name: str,
    config: Any,
    report: Report,
    numbers: Mapping[str, Any],
    console: Console,
) -> dict[str, Any]:
    """Write `name`.md, its figures `name`.png, `name`-2.png, ... and `name`.json to `place.out`.

    The page is written last: where it stands, all that it shows does.

    Args:
        place: where.
        name: of the page.
        config: what was asked; its `seed` is what every seed was made from, or the first one.
        report: what the page says; its facts come first, then command, commit and machine.
        numbers: what `name`.json holds besides the stamp and `config`.
        console: told what was written.

    Returns:
        What `name`.json holds, and `out`, the page's path.

    Raises:
        OSError: where a file cannot be written.
    """
    header = stamp(SCHEMA, config.seed)
    facts = {**report.facts, **_provenance(header)}
    figures: list[str] = []

    def part(content: Part) -> str:
        if isinstance(content, Picture):
            file = f"{name}.png" if not figures else f"{name}-{len(figures) + 1}.png"
            figures.append(file)
            with replacing_file(place.out / file) as beside:
                beside.write_bytes(content.png)
            return f"![{content.caption}]({file})\n\n*{content.caption}*"
        if isinstance(content, Grid):
            return markdown(content).strip("\n")
        if isinstance(content, Links):
            return "\n".join(f"- [{path}]({path}): {words}" for path, words in content.entries)
        if isinstance(content, Details):
            return f"{content.summary}\n\n```\n{content.text}\n```"
        return content

    blocks = [f"# {report.title}", report.lead]
    blocks.append("\n".join(f"- {key}: {value}" for key, value in facts.items()))
    for section in report.sections:
        blocks += [f"## {section.title}", *map(part, section.parts)]
    blocks.append("<!-- " + "; ".join(f"{key}: {value}" for key, value in header.items()) + " -->")
    answer = {**header, "made_by": facts, "config": config, **numbers}
    write_json(place.out / f"{name}.json", answer)
    page = place.out / f"{name}.md"
    write_text(page, "\n\n".join(blocks) + "\n")
    console.say(f"written: {page}, {name}.json" + "".join(f", {file}" for file in figures))
    return {**plain(answer), "out": str(page)}


def _provenance(header: Mapping[str, Any]) -> dict[str, str]:
    where, versions = machine(), package_versions()
    engines = (f"{key} {versions[key]}" for key in ("mujoco", "jax", "numpy"))
    return {
        "command": f"`{shlex.join(['suite', *sys.argv[1:]])}`",
        "commit": str(header["git_commit"]),
        "machine": f"{where['processor']}, {where['cores']} cores; {', '.join(engines)}",
    }
