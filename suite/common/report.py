"""Write a report as one HTML file that needs no other files, scripts or network."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template

from tracks.common.grid import Grid, html_table
from tracks.common.provenance import stamp, stamp_text

SCHEMA = 1
"""Version of the page's layout."""
TEMPLATE = Path(__file__).with_name("report.html")
"""HTML page with places for the contents of a report, and the style sheet."""
OPTION = re.compile(r"--[a-z][a-z-]*")
"""An option of a command in a text; it is set as code, and not broken at its hyphens."""


@dataclass(frozen=True)
class Picture:
    """A picture that is embedded in the page."""

    png: bytes
    caption: str
    """Text below the picture, and its alternative text; may be empty."""


@dataclass(frozen=True)
class Links:
    """A list of links to files next to the report."""

    entries: Sequence[tuple[str, str]]
    """For each link: path relative to the folder of the report, and a description."""


@dataclass(frozen=True)
class Details:
    """A long text that is folded at first."""

    summary: str
    """Line that is always visible; a click on it unfolds the text."""
    text: str


@dataclass(frozen=True)
class Steps:
    """A numbered list."""

    texts: Sequence[str]


Part = str | Grid | Picture | Links | Details | Steps
"""An item of a section; a text is a paragraph."""


@dataclass(frozen=True)
class Section:
    """A part of a report with a heading."""

    title: str
    parts: Sequence[Part]
    folded: bool = False
    """Whether only the heading is shown at first."""


@dataclass(frozen=True)
class Report:
    """The contents of a report."""

    title: str
    lead: str
    """The result in one or two sentences."""
    facts: Mapping[str, str]
    """Name -> value of the conditions, such as files and versions; shown below the lead."""
    sections: Sequence[Section]


def html(report: Report, seed: int | None = None) -> str:
    """Return `report` as an HTML page, which also has the versions and the run's `seed`."""
    facts = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>"
        for name, value in report.facts.items()
    )
    body = "\n".join(_section(section) for section in report.sections)
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        title=escape(report.title),
        generator=escape(stamp_text(stamp(SCHEMA, seed))),
        lead=escape(report.lead),
        facts=facts,
        body=body,
    )


def _section(section: Section) -> str:
    title, parts = escape(section.title), "\n".join(_part(part) for part in section.parts)
    if section.folded:
        return f'<details class="section"><summary>{title}</summary>\n{parts}\n</details>'
    return f"<section>\n<h2>{title}</h2>\n{parts}\n</section>"


def _part(part: Part) -> str:
    if isinstance(part, Grid):
        return html_table(part)
    if isinstance(part, Picture):
        data, caption = base64.b64encode(part.png).decode("ascii"), escape(part.caption)
        image = f'<img src="data:image/png;base64,{data}" alt="{caption}">'
        below = f"<figcaption>{caption}</figcaption>" if caption else ""
        return f"<figure>{image}{below}</figure>"
    if isinstance(part, Links):
        entries = "".join(
            f'<li><a href="{escape(path)}">{escape(path)}</a> {escape(words)}</li>'
            for path, words in part.entries
        )
        return f"<ul>{entries}</ul>"
    if isinstance(part, Details):
        summary = f"<summary>{escape(part.summary)}</summary>"
        return f"<details>{summary}<pre>{escape(part.text)}</pre></details>"
    if isinstance(part, Steps):
        return f"<ol>{''.join(f'<li>{_words(text)}</li>' for text in part.texts)}</ol>"
    return f"<p>{_words(part)}</p>"


def _words(text: str) -> str:
    """Return a text as HTML, with options as code."""
    return OPTION.sub(r"<code>\g<0></code>", escape(text))
