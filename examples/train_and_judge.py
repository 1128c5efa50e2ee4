"""Train a policy through the point mass for about a minute, and judge it in MuJoCo.

Run: python examples/train_and_judge.py [FOLDER [ITERATIONS]]; the same call again resumes the
training. `suite train` and `suite eval` do this with tables and intervals.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from suite import evaluate_policy, train_policy


def main(folder: Path, iterations: int) -> None:
    """Train for `iterations` gradient steps into `folder`, and fly five tracks."""
    # `suite train --list-settings` lists the settings.
    settings = ["loss.progress=1.0"]
    policy = train_policy(folder, "quick", settings=settings, iterations=iterations, seed=3)

    results = evaluate_policy(policy, track="zigzag", difficulty=0, trials=5, workers=1)
    for result in results:
        print(f"seed {result.seed}: {result.gates_passed} gates, {result.ending}")
    print(f"{sum(result.success for result in results)} of {len(results)} succeed")


if __name__ == "__main__":
    arguments = sys.argv[1:]
    main(
        Path(arguments[0]) if arguments else Path(tempfile.mkdtemp()),
        int(arguments[1]) if arguments[1:] else 100,
    )
