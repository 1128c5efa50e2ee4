"""Which flight would tell two effects apart."""

from __future__ import annotations

from suite.diagnose.plans.separating import separations_of

OTHERWISE = "fly faster, with changes of thrust, speed, heading and height"


def advice(name: str, rival: str) -> str:
    """Return a line that says which flight would tell `name` from `rival`."""
    known = separations_of((name, rival))
    return f"{name} from {rival}: {known[0].words if known else OTHERWISE}"
