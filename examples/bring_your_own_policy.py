"""Write a policy in torch, export it, and load it as `suite eval` does.

The policy has no memory: it flies towards the next gate's centre, slower near obstacles, and brakes
sideways motion. Run: python examples/bring_your_own_policy.py [FOLDER]; then
`suite eval --policy FOLDER/to_the_gate.onnx`.
"""

from __future__ import annotations

import json
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import onnx
import torch

from policies.policy import load_policy


class ToTheGate(torch.nn.Module):
    """Wanted acceleration towards a speed of 1 to 3 m/s in the direction of the gate."""

    def forward(self, state: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        """Return the action (batch, 3) [m/s^2] in body axes."""
        vel_b, gate_b = state[:, 0:3], state[:, 6:9]
        direction_b = gate_b / gate_b.norm(dim=1, keepdim=True).clamp(min=0.1)
        nearness = image.amax(dim=(1, 2)).clamp(0.0, 2.0)[:, None]  # 0: nothing within 5 m
        return 2.0 * ((3.0 - nearness) * direction_b - vel_b)


EXAMPLE = (torch.zeros(2, 12), torch.zeros(2, 24, 32))
# The policy's rate and camera are stored in its file; keys that are left out have defaults.
LABEL = json.dumps({"spec": {"rate_hz": 50.0, "camera": {"pitch_deg": 20.0}}})


def write_onnx(module: torch.nn.Module, path: Path) -> None:
    """Write the module as ONNX, which is loaded without `--trust`. Torch drops unused inputs."""
    names = ["state", "image", "action"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of this exporter
        # Torch's other exporter, without `dynamo=False`, needs the package onnxscript.
        torch.onnx.export(module, EXAMPLE, str(path), dynamo=False, input_names=names[:2],
                          output_names=names[2:], dynamic_axes={n: {0: "batch"} for n in names},
                          )  # fmt: skip
    model = onnx.load(path)
    onnx.helper.set_model_props(model, {"policy.json": LABEL})
    onnx.save(model, path)


def write_torch(module: torch.nn.Module, path: Path) -> None:
    """Write the module as a torch program, which is code: it is loaded with `--trust` only."""
    batch = {0: torch.export.Dim("batch")}
    program = torch.export.export(module, EXAMPLE, dynamic_shapes=(batch, batch))
    torch.export.save(program, path, extra_files={"policy.json": LABEL})


def main(folder: Path) -> None:
    """Export the policy to `folder` in both formats, and compute one action with each."""
    folder.mkdir(parents=True, exist_ok=True)
    module = ToTheGate().eval()
    write_onnx(module, folder / "to_the_gate.onnx")
    write_torch(module, folder / "to_the_gate.pt2")
    state = np.zeros((1, 12), np.float32)
    state[0, 5] = 1.0  # level: world z is body z
    state[0, 6:9] = [4.0, 3.0, 0.0]  # the gate is 5 m away, ahead and to the left
    image = np.full((1, 24, 32), -0.3, np.float32)  # nothing within the camera's range
    for name in ("to_the_gate.onnx", "to_the_gate.pt2"):
        # A torch program can run any code; this one was written above, so it is trusted.
        policy = load_policy(folder / name, trust=name.endswith(".pt2"))
        action, _ = policy.act(policy.start(1), state, image, np.array([True]))
        print(f"{folder / name} at {policy.spec.rate_hz:g} Hz: action {action[0].tolist()} m/s^2")


if __name__ == "__main__":
    arguments = sys.argv[1:]
    main(Path(arguments[0]) if arguments else Path(tempfile.mkdtemp()))
