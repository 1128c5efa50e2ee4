"""Experiments that end in a document: the paper's tables, and what they leave out.

An experiment is a file here with `Config`, a frozen dataclass that becomes its options, and
`run(config, place, console)`, which returns what --json prints; and one line in the table below.
"""

EXPERIMENTS: tuple[str, ...] = (
    "table2",
    "robustness",
    "randomisation",
    "seeds",
    "ablation",
    "schemes",
    "ideas",
)
"""Names; NAME lives in suite/experiments/NAME.py."""
