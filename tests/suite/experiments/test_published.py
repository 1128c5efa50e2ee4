"""The published pages: all of them made in order, and what is newer than a page."""

import json
import re
from dataclasses import replace
from pathlib import Path

from policies import shipped
from suite.cli import parse
from suite.commands import reproduce as command
from suite.common.console import Console
from suite.experiments import EXPERIMENTS, published
from suite.experiments.study.cache import FLIES, code_digest, page_code
from suite.judging.content import policy_digest


def write_page(folder, name, flown, code):
    made_by = {"ours": f"{flown[0]}, SHA-256 {flown[1][:16]}", "vehicle": "reference"}
    page = {"git_commit": "f8502435b6b42b44", "made_by": made_by, "code_sha256": code}
    (folder / f"{name}.json").write_text(json.dumps(page))


def test_a_page_is_older_than_another_policy_or_other_code(tmp_path, capsys):
    code, current = code_digest(*FLIES), policy_digest(shipped.DEFAULT)
    write_page(tmp_path, "table2", (shipped.DEFAULT, current), code)
    write_page(tmp_path, "simulators", (shipped.DEFAULT, "0" * 16), code)
    write_page(tmp_path, "robustness", ("runs/mine", current), "another")
    write_page(tmp_path, "faults", (shipped.DEFAULT, current), code)
    write_page(tmp_path, "schemes", (shipped.DEFAULT, current), page_code("schemes"))
    _, config = parse("reproduce", ["status", "--out", str(tmp_path)])
    pages = command.run(config, Console())["pages"]
    assert pages["table2"] == {"commit": "f8502435b6b42b44", "newer": []}
    assert pages["simulators"]["newer"] == ["policy"]
    assert pages["robustness"]["newer"] == pages["faults"]["newer"] == ["code"]
    assert pages["schemes"]["newer"] == []
    assert pages["ablation"]["newer"] is None
    assert "not made" in capsys.readouterr().out


def test_all_makes_every_page_by_the_command_of_the_published_one(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(command, "_make_page", lambda config, console: asked.append(config) or {})
    _, config = parse("reproduce", ["all", "--out", str(tmp_path)])
    assert list(command.run(config, Console())["seconds"]) == list(published.PUBLISHED)
    assert [type(c.experiment).__module__.rpartition(".")[2] for c in asked] == list(
        published.PUBLISHED
    )
    assert set(published.PUBLISHED) <= set(EXPERIMENTS)
    assert all(replace(c, experiment=None) == replace(config, experiment=None) for c in asked)
    results = Path(__file__).parents[3] / "docs" / "results"
    compared = []
    for name, options in published.PUBLISHED.items():
        if not (page := results / f"{name}.json").is_file():
            continue
        command_line = json.loads(page.read_text())["made_by"]["command"].strip("`")
        assert command_line.startswith(f"suite reproduce {name} "), name
        given = re.sub(r"--(out|workers|policy) \S+", "", command_line).split()[3:]
        assert sorted(given) == sorted(options.split()), name
        compared.append(name)
    assert len(compared) >= 6
