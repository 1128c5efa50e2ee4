"""`suite reproduce` in a test, and what holds for every document that it writes."""

import json
import re
from pathlib import Path

from policies import shipped
from policies.formats.checkpoint import CONFIG, WEIGHTS
from suite import cli


def unpainted(monkeypatch):
    """Let matplotlib save figures as empty files: painting takes longer than short flights."""

    def save(figure, file, **_):
        empty = b"\x89PNG"
        file.write(empty) if hasattr(file, "write") else Path(file).write_bytes(empty)

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", save)


def reproduce(tmp_path, name, *args):
    """Run `suite reproduce` into folders of `tmp_path` and return its exit code."""
    place = ["--out", str(tmp_path / "docs"), "--cache", str(tmp_path / "cache")]
    return cli.main(["reproduce", name, *args, *place])


def another_racer(folder, seed):
    """Write a policy to `folder` that flies as race-paper does and is another to every digest."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / WEIGHTS).write_bytes((shipped.locate("race-paper") / WEIGHTS).read_bytes())
    config = json.loads((shipped.locate("race-paper") / CONFIG).read_text())
    (folder / CONFIG).write_text(json.dumps({**config, "seed": seed}))


def page(tmp_path, name):
    """Return a document's text and numbers, having checked what holds for all."""
    folder = tmp_path / "docs"
    text = (folder / f"{name}.md").read_text()
    for target in re.findall(r"\]\(([^)]+)\)", text):
        assert (folder / target).read_bytes().startswith(b"\x89PNG"), target
    numbers = json.loads((folder / f"{name}.json").read_text())
    assert set(numbers) >= {"schema", "suite_version", "git_commit", "seed", "config", "made_by"}
    assert numbers["git_commit"] in text and "- machine: " in text and "- command: `" in text
    tables = re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)
    assert tables
    for table in tables:
        assert len({line.replace("\\|", "").count("|") for line in table.splitlines()}) == 1
    return text, numbers
