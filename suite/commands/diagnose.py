"""The command `suite diagnose`: name the effects that a vehicle file lacks, from flights."""

from __future__ import annotations

from typing import Any

from suite.common.console import Console, counted
from suite.diagnose.config import Config


def run(config: Config, console: Console) -> dict[str, Any]:
    """Diagnose, and print the verdict, the named effects and the next steps."""
    from suite.diagnose.report.summary import components, next_steps
    from suite.diagnose.run import diagnose_files

    result = diagnose_files(config, console)
    console.say(f"verdict: {result['verdict']}")
    console.say(result["headline"])
    for effect in result["effects"]:
        alternatives = ", ".join(effect["alternatives"])
        note = f" (not distinguishable from {alternatives} on these flights)"
        console.say(f"  {effect['name']}{note if alternatives else ''}")
        for component in components(effect):
            value, interval = component.texts()
            suffix = f", 95 %: {interval}" if interval else ""
            console.say(f"    {component.label}: {value}{suffix}")
    if result["warnings"]:
        console.say(f"warnings: {len(result['warnings'])}, printed above and in the report")
    if result["not_examined"]:
        console.say(f"not examined: {', '.join(result['not_examined'])}")
    for step in next_steps(result):
        console.say(f"next: {step}")
    if "plan" in result:
        count, folder = len(result["plan"]["flights"]), config.out / "plan"
        console.say(f"plan: {counted(count, 'flight')}{f': {folder}' if count else ''}")
    console.say(f"report: {config.out / 'report.html'}")
    return result
