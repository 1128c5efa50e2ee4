"""The policy network as a torch module with the same outputs, for export and deployment."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import nn

from policies.networks.network import LEAK, flat_features
from policies.networks.tree_arrays import image_weight, kernel_oihw, rows_are_outputs
from policies.spec import PolicySpec

CONVOLUTIONS = ("conv1", "conv2", "conv3")
LINEAR = ("state", "action")
"""Convolutions, and linear layers, whose weights only need another layout."""


class TorchTwin(nn.Module):
    """The CNN-GRU of `policies.networks.network`, built from torch's layers."""

    def __init__(self, spec: PolicySpec) -> None:
        """Create the layers; `torch_twin` loads their parameters."""
        super().__init__()
        first, second, third = spec.channels
        self.pool = nn.MaxPool2d(2)
        self.conv1 = nn.Conv2d(1, first, 2, stride=2, bias=False)
        self.conv2 = nn.Conv2d(first, second, 3, bias=False)
        self.conv3 = nn.Conv2d(second, third, 3, bias=False)
        self.image = nn.Linear(flat_features(spec), spec.hidden_size, bias=False)
        self.state = nn.Linear(spec.state_size, spec.hidden_size)
        self.gru = nn.GRUCell(spec.hidden_size, spec.hidden_size)
        self.action = nn.Linear(spec.hidden_size, spec.action.size, bias=False)
        self.leak = nn.LeakyReLU(LEAK)

    def forward(
        self, state: torch.Tensor, image: torch.Tensor, hidden: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the output (N, action size) and the next hidden state; see `network.step`."""
        x = self.pool(image.unsqueeze(1))
        x = self.leak(self.conv1(x))
        x = self.leak(self.conv2(x))
        x = self.leak(self.conv3(x))
        x = self.leak(self.image(x.flatten(1)) + self.state(state))
        hidden = self.gru(x, hidden)
        return self.action(self.leak(hidden)), hidden


def torch_twin(params: Mapping[str, np.ndarray], spec: PolicySpec) -> TorchTwin:
    """Return the module with `params` loaded, in evaluation mode and without gradients."""
    arrays = {f"{name}.weight": kernel_oihw(params[f"{name}.weight"]) for name in CONVOLUTIONS}
    arrays |= {f"{name}.weight": rows_are_outputs(params[f"{name}.weight"]) for name in LINEAR}
    arrays |= {
        "image.weight": image_weight(params, spec),
        "state.bias": np.array(params["state.bias"]),
        "gru.weight_ih": rows_are_outputs(params["gru.weight_input"]),
        "gru.weight_hh": rows_are_outputs(params["gru.weight_hidden"]),
        "gru.bias_ih": np.array(params["gru.bias_input"]),
        "gru.bias_hh": np.array(params["gru.bias_hidden"]),
    }
    twin = TorchTwin(spec).eval()
    twin.load_state_dict({name: torch.from_numpy(value) for name, value in arrays.items()})
    return twin.requires_grad_(False)
