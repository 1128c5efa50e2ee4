"""Make a training run and its judgement a shipped policy with its card.

    python tools/ship.py RUN EVAL [--name racer]

RUN is a folder of `suite train`, EVAL one of `suite eval` of RUN/policy.
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
from pathlib import Path

from policies.checkpoint import CONFIG, WEIGHTS
from suite.console import duration
from suite.loop.charts import training_chart
from suite.loop.compare import BEFORE
from suite.train import curve
from tracks.files import replacing_folder

SHELF = Path(__file__).resolve().parent.parent / "policies" / "shipped"


def card(name: str, run: Path, judged: Path) -> str:
    """Return the card as Markdown: how it was made, its curve, its table."""
    made = json.loads((run / "run.json").read_text(encoding="utf-8"))
    flown = json.loads((judged / "run.json").read_text(encoding="utf-8"))
    rows = curve.read(run)
    episode = made["config"]["episode"]
    seconds = sum(episode["batch"] * episode["steps"] / row["steps_per_s"] for row in rows)
    machine = made["machine"]
    table = (judged / "table.md").read_text(encoding="utf-8")
    return f"""# {name}

CNN-GRU of Su et al. 2026 (514k parameters), trained in the point mass on the `random` tracks only;
it has seen neither the judged families nor the vehicle of the tables.

| | |
|---|---|
| made by | `{shlex.join(made["command"])}` |
| seed | {made["seed"]} |
| commit | {made["git_commit"]} |
| machine | {machine["processor"]}, {machine["cores"]} cores, no GPU |
| training | {len(rows)} iterations in {duration(seconds)} |

![Gates passed, collisions and speed over the training](curve.png)

## Judged

By `{shlex.join(flown["command"])}`, at commit {flown["git_commit"]}. The trials' seeds were not
flown while the recipe was made.

{table}"""


def main() -> None:
    """Write policies/shipped/NAME from the command line's folders."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of suite train")
    parser.add_argument("eval", type=Path, help="folder of suite eval of that run's policy")
    parser.add_argument("--name", default="racer", help="the shipped policy's name")
    options = parser.parse_args()
    with replacing_folder(SHELF / options.name) as beside:
        for file in (WEIGHTS, CONFIG):
            shutil.copy(options.run / "policy" / file, beside / file)
        (beside / "curve.png").write_bytes(training_chart({BEFORE: curve.read(options.run)}))
        text = card(options.name, options.run, options.eval)
        (beside / "card.md").write_text(text, encoding="utf-8")
    print(f"shipped {SHELF / options.name}")


if __name__ == "__main__":
    main()
