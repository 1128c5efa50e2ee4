"""Make a shipped policy with its card from a training run and its evaluation.

    python tools/ship.py RUN --eval EVAL [--name race] [--speed 0.8]

The card is a page that says how the policy was made and how well it flies. RUN is a folder of
`suite train`, EVAL is a folder of `suite eval`. Without EVAL the card has no table of results. A
policy with a speed input gets --speed as its usual speed.
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
from dataclasses import asdict, replace
from pathlib import Path

from policies import contract
from policies.formats.checkpoint import CONFIG, WEIGHTS
from policies.formats.policy_file import load_policy_checkpoint
from suite.common import curve
from suite.common.charts import curves_chart
from suite.common.console import duration
from tracks.common.files import replacing_folder, write_json

SHELF = Path(__file__).resolve().parent.parent / "policies" / "shipped"
"""Folder of the shipped policies."""


def card(name: str, run: Path, judged: Path | None) -> str:
    """Return the card as Markdown.

    It is of the training in `run`. Without `judged`, the folder of the evaluation, it has no table
    of results.
    """
    training, rows = json.loads((run / "run.json").read_text(encoding="utf-8")), curve.read(run)
    seconds = sum(row["seconds"] for row in rows)
    row = (
        f"| `{shlex.join(training['command'])}` | {training['seed']} | {training['git_commit']} "
        f"| {len(rows)} | {duration(seconds)} |"
    )
    machine = training["machine"]
    cores = machine["cores"]
    checkpoint = load_policy_checkpoint(run / "policy")
    size = sum(array.size for array in checkpoint.params.values())
    quadrotor = training["config"]["quadrotor"]
    name_of_vehicle = quadrotor["vehicle"]["name"] if quadrotor else ""
    dynamics = f"quadrotors around `{name_of_vehicle}`" if quadrotor else "the point mass"
    text = f"""# {name}

CNN-GRU of Su et al. 2026 ({checkpoint.spec.state_size} numbers and a depth image,
{size / 1000:.0f}k parameters), trained through {dynamics} on the `random` tracks only. The training
had neither the judged families nor the vehicle of the tables. The recipe's numbers were chosen by
flights of earlier recipes on the judged tracks and vehicle, at other seeds.

| made by | seed | commit | iterations | time |
|---|---|---|---|---|
{row}

On {machine["processor"]}, {cores} core{"s" * (cores != 1)}.

![Gates passed, collisions and speed over the training](curve.png)
"""
    if judged is None:
        return text
    evaluation = json.loads((judged / "run.json").read_text(encoding="utf-8"))
    table = (judged / "table.md").read_text(encoding="utf-8")
    return f"""{text}
## Judged

By `{shlex.join(evaluation["command"])}`, which reproduces this table exactly. The
trials' seeds were not flown while the recipe was made.

{table}"""


def main() -> None:
    """Write policies/shipped/NAME from the folders in the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of suite train")
    parser.add_argument("--eval", type=Path, help="folder of suite eval of the run's policy")
    parser.add_argument("--name", default="race", help="the shipped policy's name")
    parser.add_argument("--speed", type=float, help="spec.speed, instead of the run's")
    options = parser.parse_args()
    with replacing_folder(SHELF / options.name) as new:
        policy = options.run / "policy"
        shutil.copy(policy / WEIGHTS, new / WEIGHTS)
        config = json.loads((policy / CONFIG).read_text(encoding="utf-8"))
        if options.speed is not None:
            spec = replace(load_policy_checkpoint(policy).spec, speed=options.speed)
            new_contract = contract.contract_of(spec, (spec.hidden_size,)).to_json()
            config |= {"spec": asdict(spec), contract.KEY: new_contract}
        write_json(new / CONFIG, config)
        load_policy_checkpoint(new)  # refuses it before it replaces the shipped one
        (new / "curve.png").write_bytes(curves_chart({"training": curve.read(options.run)}))
        text = card(options.name, options.run, options.eval)
        (new / "card.md").write_text(text, encoding="utf-8")
    print(f"shipped {SHELF / options.name}")


if __name__ == "__main__":
    main()
