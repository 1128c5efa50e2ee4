"""Write a policy of your own in torch, export it, and load it as the judge does.

It has no memory and does not look at the image: it flies at the next gate's centre and brakes
sideways. Run: python examples/bring_your_own_policy.py [FOLDER]; then
`suite eval --policy FOLDER/to_the_gate.pt2 --trust`.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

from policies.policy import load_policy


class ToTheGate(torch.nn.Module):
    """Wanted acceleration towards a speed of 3 m/s in the direction of the gate."""

    def forward(self, state: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        """Return the action (batch, 3) [m/s^2] in body axes."""
        vel_b, gate_b = state[:, 0:3], state[:, 6:9]
        direction_b = gate_b / gate_b.norm(dim=1, keepdim=True).clamp(min=0.1)
        return 2.0 * (3.0 * direction_b - vel_b)


def main(folder: Path) -> None:
    """Export the policy to `folder` and ask it for one action."""
    example = (torch.zeros(2, 12), torch.zeros(2, 24, 32))
    batch = {0: torch.export.Dim("batch")}
    program = torch.export.export(ToTheGate().eval(), example, dynamic_shapes=(batch, batch))
    # What it expects of the world travels with it; keys that are left out take the defaults.
    label = json.dumps({"spec": {"rate_hz": 50.0, "camera": {"pitch_deg": 20.0}}})
    path = folder / "to_the_gate.pt2"
    torch.export.save(program, path, extra_files={"policy.json": label})

    policy = load_policy(path, trust=True)  # a .pt2 holds code; this one is ours
    state = np.zeros((1, 12), np.float32)
    state[0, 5] = 1.0  # level: world z is body z
    state[0, 6:9] = [4.0, 3.0, 0.0]  # the gate is 5 m away, ahead and to the left
    image = np.full((1, 24, 32), -0.3, np.float32)  # nothing within the camera's range
    action, _ = policy.act(policy.start(1), state, image, np.array([True]))
    print(f"{policy.name} at {policy.spec.rate_hz:g} Hz: action {action[0].tolist()} m/s^2")


if __name__ == "__main__":
    given = sys.argv[1:]
    main(Path(given[0]) if given else Path(tempfile.mkdtemp()))
