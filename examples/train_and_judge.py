"""Train a policy through the point mass for about a minute, and judge it in MuJoCo.

Run: python examples/train_and_judge.py [FOLDER [ITERATIONS]]; the same call again goes on where the
training was stopped. `suite train` and `suite eval` do this with tables and intervals.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from eval.judging.judge import JudgeOptions, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import TrialSpec
from policies.policy import load_policy
from suite.common.console import Console
from suite.train.recipes import named_recipe, with_iterations
from suite.train.run import train


def main(folder: Path, iterations: int) -> None:
    """Train for `iterations` gradient steps into `folder`, and fly five tracks."""
    config = with_iterations(named_recipe("quick"), iterations)
    # Every setting is a field of a frozen dataclass; --set changes the same ones by name.
    config = replace(config, loss=replace(config.loss, progress=1.0), seed=3)
    train(config, folder, Console())

    results = fly(
        load_policy(folder / "policy"),
        [TrialSpec("zigzag", difficulty=0, seed=seed) for seed in range(5)],
        load_vehicle("reference"),
        options=JudgeOptions(workers=1),
    )
    for result in results:
        print(f"seed {result.seed}: {result.gates_passed} gates, {result.ending}")
    print(f"{sum(result.success for result in results)} of {len(results)} succeed")


if __name__ == "__main__":
    given = sys.argv[1:]
    main(
        Path(given[0]) if given else Path(tempfile.mkdtemp()),
        int(given[1]) if given[1:] else 100,
    )
