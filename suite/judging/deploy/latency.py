"""Measure the time of a policy's single steps on one thread, in C, ONNX Runtime and torch.

These engines run in turn, in blocks of steps, so that the load of the machine affects all alike.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from policies.formats.c.c_file import CPolicy
from policies.formats.c.project import random_observations
from policies.formats.policy_file import PolicyCheckpoint

Step = Callable[[], Any]
"""Makes one step on fixed inputs, and keeps the policy's memory; may return (1, size) actions."""
BLOCK = 100
"""Number of timed steps of one engine before the next engine runs."""
WARM = 10
"""Number of untimed steps before a block, which load the weights into the processor's cache."""


class Timing(NamedTuple):
    """Times of single steps [s]."""

    median_s: float
    """Median [s]."""
    p99_s: float
    """99th percentile [s]."""
    max_s: float
    """Longest time [s]; it includes interruptions by the operating system."""


def time_in_turn(steps: Mapping[str, Step], rounds: int = 20) -> dict[str, Timing]:
    """Return the times of the engines `steps`, which run in turn for `rounds` blocks each."""
    times: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(rounds):
        for name, step in steps.items():
            for _ in range(WARM):
                step()
            for _ in range(BLOCK):
                started = time.perf_counter()
                step()
                times[name].append(time.perf_counter() - started)
    return {
        name: Timing(float(np.median(seconds)), float(np.quantile(seconds, 0.99)), max(seconds))
        for name, seconds in times.items()
    }


def c_step(policy: CPolicy) -> Step:
    """Return a step of a policy in C, whose functions are called as on a flight controller."""
    state, image, _ = random_observations(policy.spec, 1)
    memory, action = policy.start(1), np.zeros((1, policy.spec.action.size), np.float32)
    arrays = (memory, state, image, action)
    library = ctypes.CDLL(str(policy.library))
    library.policy_reset(ctypes.c_void_p(memory.ctypes.data))
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in arrays]
    function = library.policy_step

    def step() -> np.ndarray:
        function(*pointers)
        return arrays[-1]  # this use of `arrays` keeps their memory as long as the pointers

    return step


def onnx_steps(checkpoint: PolicyCheckpoint) -> tuple[Step, Step]:
    """Return two steps of ONNX Runtime on one thread.

    The first is the usual call. The second has all inputs and outputs bound to memory beforehand.
    """
    import onnxruntime

    from policies.formats.export import onnx_file

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    providers = ["CPUExecutionProvider"]
    session = onnxruntime.InferenceSession(onnx_file(checkpoint, {}), options, providers=providers)
    state, image, _ = random_observations(checkpoint.spec, 1)
    hidden = np.zeros((1, checkpoint.spec.hidden_size), np.float32)
    action = np.zeros((1, checkpoint.spec.action.size), np.float32)
    feed: dict[str, Any] = {"state": state, "image": image, "hidden": hidden}
    binding = session.io_binding()
    for name, value in feed.items():
        binding.bind_ortvalue_input(name, onnxruntime.OrtValue.ortvalue_from_numpy(value))
    for name, value in (("action", action), ("hidden_next", hidden)):
        binding.bind_ortvalue_output(name, onnxruntime.OrtValue.ortvalue_from_numpy(value))

    def usual_step() -> Any:
        action, feed["hidden"] = session.run(None, feed)
        return action

    return usual_step, lambda: session.run_with_iobinding(binding)


def torch_step(checkpoint: PolicyCheckpoint) -> Step:
    """Return a step of the torch module, uncompiled; the caller sets the number of threads."""
    import torch

    from policies.formats.torch_twin import torch_twin

    twin = torch_twin(checkpoint.params, checkpoint.spec)
    state, image = map(torch.from_numpy, random_observations(checkpoint.spec, 1)[:2])
    memory = [torch.zeros(1, checkpoint.spec.hidden_size)]

    def step() -> Any:
        with torch.inference_mode():
            action, memory[0] = twin(state, image, memory[0])
        return action

    return step
