"""`suite check`: faults of an interface, before anything is concluded from flights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from suite.common.console import Console
from tracks.input.ranges import Range


@dataclass(frozen=True)
class Config:
    """Check a policy's interface: its contract, and the usual mistakes of unit, frame and scale."""

    policy: str = ""
    """A shipped policy's name, a checkpoint's folder, or a .onnx, .pt2, .pt or .c file."""
    trials: Annotated[int, Range(0, 1000)] = 4
    """Short flights on easy tracks, by which the size of its actions is judged."""
    trust: bool = False
    """Also load policy files that can run code on this machine."""
    json: bool = False
    """Print one JSON object to standard output and nothing else."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Load and fly the policy, and list what is assumed of it and what looks wrong.

    Raises:
        ValueError: where no policy is given, or it is refused.
    """
    from policies.contract import contract_of
    from policies.policy import load_policy
    from suite.judging.checking import policy_findings

    if not config.policy:
        raise ValueError("--policy is missing; give a policy file or a shipped policy's name")
    policy = load_policy(config.policy, config.trust)
    contract = contract_of(policy.spec)
    findings = policy_findings(policy, config.trials, console)
    for finding in findings:
        console.say(f"{finding['status']}: {finding['evidence']}; {finding['fix']}")
    if not findings:
        console.say(f"{policy.name}: nothing to report")
    return {
        "policy": policy.name,
        "contract": contract.to_json(),
        "findings": findings,
        "not_identifiable": [],
    }
