"""Experiments that end in a document: the paper's tables, and what they leave out.

An experiment is a file here with `Config`, a frozen dataclass that becomes its options, and
`document(config, place, console)`, which returns the page and its numbers; and one line in the
table below. Checks of options that many have, training, judging and writing are in `study/` and
`pages/`.
"""

EXPERIMENTS: tuple[str, ...] = (
    "table2",
    "robustness",
    "randomisation",
    "seeds",
    "ablation",
    "schemes",
    "ideas",
    "worlds",
)
"""Names; NAME lives in suite/experiments/NAME.py."""
