"""Check the pages of docs/ for words that docs/conventions.md replaces, and for long sentences.

Run: python tools/words.py [--count]; it ends with 1 where a page breaks a rule. Tables, code and
docs/archive are left out, generated pages too. --count lists words and mean sentence a page.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LONGEST, MEAN, MOST = 35, 17.0, 25_000
"""Most words of a sentence, of the mean sentence, and of all pages together."""
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
"""Expression -> what to write."""


def pages() -> Iterator[Path]:
    """Yield README and the pages of docs/ that people write."""
    yield ROOT / "README.md"
    for page in sorted((ROOT / "docs").rglob("*.md")):
        if page.relative_to(ROOT / "docs").parts[0] not in ("archive", "reference"):
            yield page


def prose(text: str) -> str:
    """Return a page's sentences: no code, tables, headings, comments, links and made parts."""
    text = re.sub(r"<!-- made by.*?<!-- end of.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"```.*?```|<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"^\s*(\||#|!\[).*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"\]\([^)]*\)|`[^`]*`", "]", text)
    # A list's entry ends a sentence, whether or not it has a full stop.
    return re.sub(r"^\s*([-*]|\d+\.)\s", ". ", text, flags=re.MULTILINE)


def sentences(text: str) -> list[list[str]]:
    """Return the words of each sentence."""
    parts = re.split(r"[.!?](?=[\s\])])|:\n|\n\s*\n", prose(text))
    words = [re.findall(r"[^\W_][\w'’.-]*|\]", part) for part in parts]
    return [one for one in words if one]


def main(count: bool) -> int:
    """Print what breaks a rule, and the counts if asked."""
    found, total, every = 0, 0, list[int]()
    for page in pages():
        text, name = page.read_text(encoding="utf-8"), page.relative_to(ROOT)
        lengths = [len(one) for one in sentences(text)]
        total, every = total + sum(lengths), every + lengths
        if count:
            mean = sum(lengths) / max(len(lengths), 1)
            print(f"{sum(lengths):6} words, {mean:4.1f} a sentence  {name}")
        for words in (one for one in sentences(text) if len(one) > LONGEST):
            found += 1
            print(f"{name}: {len(words)} words (allowed {LONGEST}): {' '.join(words[:9])} …")
        for pattern, instead in REPLACED.items():
            for match in re.finditer(pattern, prose(text), re.IGNORECASE):
                found += 1
                print(f"{name}: {match[0]!r}: write {instead}")
    mean = sum(every) / len(every)
    print(f"{total} words (allowed {MOST}), mean sentence {mean:.1f} words (allowed {MEAN:g})")
    return int(found > 0 or total > MOST or mean > MEAN)


if __name__ == "__main__":
    raise SystemExit(main("--count" in sys.argv[1:]))
