"""The page `four_gates`: the shipped policies on the tracks of the paper's ablation.

These tracks have four gates (Su et al. 2026). The policies fly them in the dynamics of the last
phase of their training, as the trained policies of the page `ablation` do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import tyro

from eval.judging.statistics import Interval, wilson
from eval.judging.tables import percent
from policies import shipped
from suite.common.console import Console
from suite.experiments.ablation import RATES
from suite.experiments.pages import paper
from suite.experiments.pages.document import PageContents
from suite.experiments.study import judging, options
from suite.experiments.study.cache import Workspace
from suite.train.config import TrainConfig
from tracks.common.grid import Grid, table
from tracks.common.names import unknown_name
from tracks.input.ranges import Range, Seed, Trials

PAPER = "field 0.4"
"""The setting of the paper's ablation with the vector field, see `paper.ablation`."""


@dataclass(frozen=True)
class Config:
    """Fly the shipped policies on tracks of four gates, in the dynamics of their training."""

    policy: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A shipped policy's name; may be given several times. Without it all shipped policies fly."""
    trials: Trials = 300
    """Unseen worlds that every policy flies."""
    seconds: Annotated[float, Range(0.5, 3600.0)] = 10.0
    """Length of a trial, from a standing start [s]."""
    seed: Seed = 1000
    """Seed of the unseen worlds."""


def document(config: Config, workspace: Workspace, console: Console) -> PageContents:
    """Return the contents of the page; every policy is flown again.

    Raises:
        ValueError: for an unknown policy, and for the seed of a policy's training.
    """
    from policies.formats.policy_file import load_policy_checkpoint
    from suite.experiments.study.validation import make_validation
    from suite.train.run import start_params

    recipes = {name: flown_recipe(name) for name in config.policy or shipped.names()}
    measured = {}
    for name, recipe in recipes.items():
        if recipe.seed == config.seed:
            raise ValueError(
                f"--seed {config.seed} is that of the training of {name}, which would be measured "
                "on worlds of its training; give another"
            )
        params = start_params(load_policy_checkpoint(shipped.locate(name)), recipe.spec)
        measure = make_validation(recipe, config.trials, config.seed, config.seconds)
        measured[name] = measure(params)
        console.note(f"{name}: success cross {measured[name]['success_cross']:.1%}")
    facts = {
        **judging.policy_facts(judging.named_policies(tuple(recipes))),
        "tracks": f"those of the recipe `quick`, with {options.GATES} gates",
        "unseen worlds": f"{config.trials}, seed {config.seed}, {config.seconds:g} s each",
    }
    rows = [
        {
            "policy": name,
            **scores,
            "intervals": {rate: interval(scores[rate], config.trials) for rate in RATES},
        }
        for name, scores in measured.items()
    ]
    parts = {"The shipped policies on four gates": [_grid(measured, config.trials)]}
    return PageContents(facts, parts, {"rows": rows})


def flown_recipe(policy: str) -> TrainConfig:
    """Return the last phase of a shipped policy's recipe, on the tracks of the page `ablation`.

    Raises:
        ValueError: if no shipped policy has this name.
    """
    from suite.train.overrides import phase_configs
    from suite.train.recipes import named_recipe

    if policy not in shipped.names():
        raise unknown_name("shipped policy", policy, shipped.names())
    last = phase_configs(named_recipe(policy))[-1]
    tracks = replace(named_recipe("quick").episode, gates=options.GATES)
    return replace(last, episode=tracks)


def interval(rate: float, trials: int) -> Interval:
    """Return a rate of `trials` trials with its 95 % Wilson interval."""
    return wilson(round(trials * rate), trials)


def _grid(measured: Mapping[str, Mapping[str, float]], trials: int) -> Grid:
    """Return the table of the page: a row for each policy, and one for the paper."""
    source, printed = paper.ablation()
    headers = ["policy", "success cross", "collision-free rate", "v_max [m/s]", "largest [m/s]"]
    lines = []
    for name, scores in measured.items():
        rates = [percent(interval(scores[rate], trials)) for rate in RATES]
        speeds = [f"{scores[speed]:.1f}" for speed in ("v_max", "v_max_most")]
        lines.append([name, *rates, *speeds, f"{scores['gates']:.2f}"])
    row = printed[PAPER]
    rates = [f"{100 * getattr(row, rate):.0f} %" for rate in RATES]
    lines.append(["paper, with the field", *rates, f"{row.v_max:.1f}", "-", "-"])
    return table([*headers, "gates"], lines, note=f"Paper: {source}.")
