"""What `suite check --policy` finds: a contract, the answers, and the actions in flight."""

from __future__ import annotations

from typing import Any

from policies.contract import contract_of, summary
from policies.policy import Policy
from suite.common.console import Console

TIME_LIMIT_S = 5.0
"""Of a flight [s]."""


def policy_findings(policy: Policy, trials: int, console: Console) -> list[dict[str, Any]]:
    """Return what looks wrong about a policy's interface, as records of `suite check`.

    Args:
        policy: as it was loaded.
        trials: short flights by which its actions are judged; 0 flies none.
        console: told the contract and the share of limited actions.
    """
    from eval.judging.outputs import doubts

    console.say(f"{policy.name}: {summary(contract_of(policy.spec))}")
    found = [_record("contract", *note) for note in getattr(policy, "notes", ())]
    found += [_record("action", *doubt) for doubt in doubts(policy)]
    return found + [_record("action", *warning) for warning in _in_flight(policy, trials, console)]


def _in_flight(policy: Policy, trials: int, console: Console) -> list[tuple[str, str, str]]:
    from eval.judging.judge import JudgeOptions, fly
    from eval.judging.outputs import actions_of
    from eval.quadrotor.vehicle_file import load_vehicle
    from eval.worlds.trial import Rules, TrialSpec

    asked = [TrialSpec("random", 0, 500_000 + seed) for seed in range(trials)]
    options = JudgeOptions(workers=1, rules=Rules(time_limit_s=TIME_LIMIT_S))
    results = fly(policy, asked, load_vehicle("racer5"), options=options)
    actions = actions_of(results, policy.spec.action)
    if actions["decisions"]:
        share, count = actions["limited"], actions["decisions"]
        console.say(f"{share:.1%} of {count} actions were limited in {trials} flights")
    return actions["warnings"]


def _record(signal: str, fault: str, evidence: str, fix: str) -> dict[str, Any]:
    return {"fault": fault, "signal": signal, "size": None, "evidence": evidence,
            "confidence": None, "status": "doubt", "fix": fix}  # fmt: skip
