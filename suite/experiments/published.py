"""The published pages of docs/results: their options, making all, and finding outdated ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from policies import shipped
from suite.experiments.study.cache import page_code
from suite.judging.content import policy_digest
from tracks.common.grid import Grid, table
from tracks.input.reading import read_json

PUBLISHED = {
    "table2": "--seed 9600000",
    "robustness": "--seed 9700000 --trials 16",
    "perception": "--seed 9910000 --trials 50 --growing-trials 16 --only vio gate-relative "
    "stereo-depth all imu+gates delay gate_map state_drift state_noise state_loss gate_detection "
    "wrong_gate image_motion stereo tof exposure frame_loss",
    "simulators": "--seed 9750000",
    "four_gates": "",
    "ablation": "",
    "schemes": "--set episode.start_speed=3.0 episode.image_stride=3 --ppo-iterations 2315",
    "faults": "--seed 7930000",
}
"""Page -> its options. `suite reproduce all` makes the pages in this order. The published page
`perception` also has policies that are trained first; the page names their commands."""


@dataclass(frozen=True)
class All:
    """Make every published page, in order; finished parts are reused."""


@dataclass(frozen=True)
class Status:
    """List the published pages in --out, and which policy or code is newer than a page."""


def page_states(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the state of every published page in `folder`, by name.

    A state has `commit`, which made the page, and `newer`, a list of what has changed since. It has
    "policy" if a shipped policy now has other weights, and "code" if the code that flies or that
    the page measures is different, docstrings and comments apart. `newer` is None without a page.
    """
    states: dict[str, dict[str, Any]] = {}
    for name in PUBLISHED:
        path = folder / f"{name}.json"
        if not path.is_file():
            states[name] = {"commit": "", "newer": None}
            continue
        try:
            page = read_json(path)
            facts = [text.partition(", SHA-256 ") for text in page["made_by"].values()]
            commit, code = page["git_commit"] or "", page.get("code_sha256")
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{path}: not the numbers of a page ({error}); make the page again with suite "
                f"reproduce {name}, or move the file away"
            ) from error
        # A policy's fact is its source and digest. Other policies than the shipped ones stand for
        # themselves: nothing can be newer.
        flown = [(policy, sha) for policy, _, sha in facts if sha and policy in shipped.names()]
        newer = ["policy"] if any(policy_digest(p)[:16] != sha for p, sha in flown) else []
        newer += ["code"] if code != page_code(name) else []
        states[name] = {"commit": commit, "newer": newer}
    return states


def status_grid(states: dict[str, dict[str, Any]]) -> Grid:
    """Return the states of the published pages as a table."""

    def text(newer: list[str] | None) -> str:
        return "not made" if newer is None else ", ".join(newer) or "-"

    lines = [[name, s["commit"][:10] or "-", text(s["newer"])] for name, s in states.items()]
    return table(["page", "made at commit", "newer than the page"], lines)
