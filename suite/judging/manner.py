"""In what manner a policy is flown: how fast it is asked to, and with whom around it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from policies.errors import PolicyError

if TYPE_CHECKING:
    from policies.policy import Policy


@dataclass(frozen=True)
class Manner:
    """What is asked of a policy besides to fly; called with one, it returns it so."""

    monitored: bool = False
    """Whether the safety monitor is around it."""
    speed: float | None = None
    """How fast it is asked to fly, 0 to 1 [1]; None: as its own spec says."""

    def __call__(self, policy: Policy) -> Policy:
        """Return `policy` flown in this manner.

        Raises:
            PolicyError: for a speed where the policy does not take one.
        """
        if self.speed is not None:
            policy = _at_speed(policy, self.speed)
        if self.monitored:
            from eval.judging.monitor import Monitored

            policy = Monitored(policy)
        return policy

    def label(self, name: str) -> str:
        """Return what tables call a policy called `name` flown in this manner."""
        name += "" if self.speed is None else f"@{self.speed:g}"
        return f"{name}+monitor" if self.monitored else name


PLAIN = Manner()
"""As the policy's own spec says, alone."""


def manners(speeds: Sequence[float], monitor: bool) -> list[Manner]:
    """Return every manner that is asked for: each speed, then each again with the monitor."""
    plain = [Manner(speed=speed) for speed in speeds] or [Manner()]
    return plain + [dataclasses.replace(manner, monitored=True) for manner in plain if monitor]


def _at_speed(policy: Any, speed: float) -> Any:
    if not policy.spec.speed_input:
        raise PolicyError(
            f"--speed {speed:g}: {policy.name} takes no speed as an input; leave --speed out, or "
            "train a policy with --set spec.speed_input=True"
        )
    return dataclasses.replace(policy, spec=dataclasses.replace(policy.spec, speed=speed))
