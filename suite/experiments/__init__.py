"""Experiments, each of which makes a result page: the paper's tables, and more.

An experiment is a module here with a line in the table below. Its `Config`, a frozen dataclass, has
its options; its `document(config, workspace, console)` returns facts, tables, charts and numbers
(`PageContents`). Training, judging and intervals are in `study/`, tables, charts and writing in
`pages/`.
"""

EXPERIMENTS: dict[str, str] = {
    "table2": "a policy on three tracks at all ten levels, next to the paper and the baseline",
    "robustness": "policies under every physical effect and under growing disturbances",
    "perception": "policies through every sensor model, as its magnitude grows",
    "ablation": "trainings with the vector field and without it, flown on unseen worlds",
    "four_gates": "the shipped policies on the tracks of the paper's ablation",
    "schemes": "PPO, our method, and our method without the field, measured as they learn",
    "faults": "faults of a log's interface put into good logs: how many are named, by kind",
    "gpu": "training and judging on an accelerator: speed, memory, and the CPU's outcomes",
    "simulators": "the shipped policies on the same trials in every simulator",
}
"""Name -> one-line summary; NAME lives in suite/experiments/NAME.py."""
OVER_ALL: dict[str, str] = {
    "all": "every published page, in order; finished parts are not repeated",
    "status": "the published pages, and which policy or code is newer than a page",
}
"""Names that stand for all pages, in suite/experiments/published.py."""
