"""The policies of the paper's table: as trained, and fine-tuned under a Delta Action Model."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from policies.policy import load_policy
from suite.common.choices import at_least
from suite.common.console import Console
from suite.experiments.cache import code_digest, digest
from suite.experiments.document import Place
from suite.judging.flying import default_policy, policy_digest
from suite.loop.config import LoopConfig, resolve
from suite.loop.run import run_loop
from suite.loop.work import Quiet

if TYPE_CHECKING:
    from suite.experiments.table2 import Config

OURS, WITH, CONTROL = "ours", "ours, with Delta Action Model", "ours, tuned as long without it"
LOOP_TRIALS = 10
"""Judged trials a cell in the loop's own tables, which are not shown here."""
LOOP_ROOMS = ("tracks", "policies", "eval", "suite/train", "suite/delta", "suite/loop")
"""Code that flies, fits and fine-tunes: a loop that older code ran is not taken for this one's."""


class Variant(NamedTuple):
    """A policy of the table."""

    name: str
    """What the table calls it."""
    policy: str
    """Name, folder or file."""
    about: str
    """Where it comes from."""


def variants_of(config: Config, place: Place, console: Console) -> list[Variant]:
    """Return the policies to be judged; the loop that makes the fine-tuned ones is run if asked.

    Raises:
        ValueError: for a policy that cannot be loaded, or options that exclude each other.
    """
    at_least("--delta-iterations", config.delta_iterations, 0)
    given = {WITH: config.delta_policy, CONTROL: config.control_policy}
    if config.delta_iterations and any(given.values()):
        raise ValueError(
            "--delta-iterations makes the fine-tuned policies and --delta-policy and "
            "--control-policy name them; give the one or the other"
        )
    policy = config.policy or default_policy()
    chosen = {OURS: policy, **{name: path for name, path in given.items() if path}}
    if config.delta_iterations:
        loop = loop_config(config, policy)
        folder = place.cache / "loops" / digest([loop, code_digest(*LOOP_ROOMS)])
        run_loop(loop, folder, Quiet())
        chosen[WITH] = str(folder / "tuned-with" / "policy")
        chosen[CONTROL] = str(folder / "tuned-without" / "policy")
    made = f", fine-tuned by suite loop in {config.delta_iterations} gradient steps"
    variants = []
    for name, path in chosen.items():
        load_policy(path)
        note = made if config.delta_iterations and name != OURS else ""
        label = policy + note if note else path
        variants.append(Variant(name, path, f"{label}, SHA-256 {policy_digest(path)[:16]}"))
    return variants


def loop_config(config: Config, policy: str) -> LoopConfig:
    """Return the loop that fine-tunes `policy`, on flights of seeds that no table judges."""
    loop = resolve(
        recipe="swift",
        policy=policy,
        difficulty="0,3,6,9",
        trials=LOOP_TRIALS,
        vehicle=config.vehicle,
        finetune_iterations=config.delta_iterations,
        changes=config.delta_set,
    )
    return replace(loop, seed=config.seed)
