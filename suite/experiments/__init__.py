"""Experiments that end in a document: the paper's tables, and what they leave out.

An experiment is a file here with `Config`, a frozen dataclass that becomes its options, and
`document(config, place, console)`, which returns the page and its numbers; and one line in the
table below. Checks of options that many have, training, judging and writing are in `study/` and
`pages/`.
"""

EXPERIMENTS: dict[str, str] = {
    "table2": "a policy on three tracks at all ten levels, beside the paper and the baseline",
    "robustness": "policies under every physical effect and under growing disturbances",
    "randomisation": "one recipe with randomised dynamics and with fixed ones, disturbed",
    "seeds": "the policies of several training seeds on the same trials, and their median",
    "ablation": "trainings with the vector field and without it, flown on unseen worlds",
    "schemes": "PPO, our method, and it without the field, measured as they learn",
    "ideas": "a recipe and variants of it with one change each, judged in pairs",
    "hidden_worlds": "loops in worlds that hide an effect: what naming it and Delta Action gives",
    "worlds": "the shipped policies on the same trials in every world, side by side",
}
"""Name -> one-line summary; NAME lives in suite/experiments/NAME.py."""
