"""The command `suite loop`: correct a simulation from flights, and fine-tune a policy in it.

The stages are: train a policy; fly it; record flights; fit a Delta Action Model to them, or name
the hidden effect; fine-tune the policy; fly again.
"""

from __future__ import annotations

from typing import Any

from suite.common.console import Console
from suite.common.work import read_workers_option
from suite.loop.options import Config


def run(config: Config, console: Console) -> dict[str, Any]:
    """Run the loop, or its unfinished stages."""
    from suite.loop.config import resolve
    from suite.loop.run import run_loop
    from suite.train.run import change_warnings

    workers = read_workers_option(config.workers, whole_cores=True)
    resolved = resolve(config)
    changed = resolved.training if resolved.policy is None else resolved.tuning
    for warning in change_warnings(changed, config.set):
        console.note(f"warning: {warning}")
    return run_loop(resolved, config.out, console, workers)
