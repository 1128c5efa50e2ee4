"""Check the pages of docs/ for words that docs/conventions.md replaces, and for long sentences.

    python tools/words.py [--count]

The exit code is 1 if a page breaks a rule. Tables, code, docs/archive and generated pages are not
checked. With --count it also prints each page's number of words and mean length of a sentence.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
"""Folder of the checkout."""
LONGEST, MEAN, MOST = 35, 17.0, 25_000
"""Largest number of words in a sentence, in the mean sentence, and in all pages together."""
REPLACED = {
    r"\bbeside\b": "next to, compared with",
    r"\bnot to be told\b|\bcannot be told\b|\bno flight can tell\b": "not identifiable",
    r"\b(is|are|was|were|be) told\b": "is reported, is given",
    r"\bmended\b|\bmend\b": "repaired",
    r"\bhidden worlds?\b": "hidden vehicle",
    r"\basked for 0\.": "--speed 0.",
    r"\bdearer\b": "with a higher weight",
    r"\bfiner eye\b": "supersampled depth",
    r"\bwhat (is left|stays|remains)\b": "the residual",
    r"\bdoubted\b|\blent\b": "held fixed",
    r"\bnobody here\b|\bno real vehicle has\b": "not yet validated on hardware",
}
"""Regular expression of words that the pages avoid -> what to write instead."""


def pages() -> Iterator[Path]:
    """Yield the paths of README and the pages of docs/ that are not generated."""
    yield ROOT / "README.md"
    for page in sorted((ROOT / "docs").rglob("*.md")):
        if page.relative_to(ROOT / "docs").parts[0] not in ("archive", "reference"):
            yield page


def prose(text: str) -> str:
    """Return a page's text without code, tables, headings, comments, links and generated parts."""
    text = re.sub(r"<!-- made by.*?<!-- end of.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"```.*?```|<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"^\s*(\||#|!\[).*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"\]\([^)]*\)|`[^`]*`", "]", text)
    # An entry of a list ends a sentence, with or without a full stop.
    return re.sub(r"^\s*([-*]|\d+\.)\s", ". ", text, flags=re.MULTILINE)


def sentences(text: str) -> list[list[str]]:
    """Return the words of each sentence."""
    parts = re.split(r"[.!?](?=[\s\])])|:\n|\n\s*\n", prose(text))
    words = [re.findall(r"[^\W_][\w'’.-]*|\]", part) for part in parts]
    return [sentence for sentence in words if sentence]


def main(count: bool) -> int:
    """Print the broken rules, and with `count` the counts; return the exit code."""
    broken, total, all_lengths = 0, 0, list[int]()
    for page in pages():
        text, name = page.read_text(encoding="utf-8"), page.relative_to(ROOT)
        lengths = [len(sentence) for sentence in sentences(text)]
        total, all_lengths = total + sum(lengths), all_lengths + lengths
        if count:
            mean = sum(lengths) / max(len(lengths), 1)
            print(f"{sum(lengths):6} words, {mean:4.1f} a sentence  {name}")
        for words in (sentence for sentence in sentences(text) if len(sentence) > LONGEST):
            broken += 1
            print(f"{name}: {len(words)} words (allowed {LONGEST}): {' '.join(words[:9])} …")
        for pattern, instead in REPLACED.items():
            for match in re.finditer(pattern, prose(text), re.IGNORECASE):
                broken += 1
                print(f"{name}: {match[0]!r}: write {instead}")
    mean = sum(all_lengths) / len(all_lengths)
    print(f"{total} words (allowed {MOST}), mean sentence {mean:.1f} words (allowed {MEAN:g})")
    return int(broken > 0 or total > MOST or mean > MEAN)


if __name__ == "__main__":
    raise SystemExit(main("--count" in sys.argv[1:]))
