"""The trainer's machine has jax, numpy and small packages only; the command line starts at once."""

import subprocess
import sys

import pytest

BLOCKED = (
    "torch onnx onnxruntime mujoco dm_control gymnasium trimesh rerun pyarrow matplotlib scipy "
    "rich tyro pandas"
)
BLOCK = f"""
import sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {BLOCKED.split()!r}:
            raise ImportError(f"{{name}} is blocked")
sys.meta_path.insert(0, Blocker())
"""


def run(script, *arguments):
    command = [sys.executable, "-W", "error", "-c", script, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True)


def test_training_and_flying_our_policy_needs_jax_and_numpy_only(checkpoint, tmp_path):
    script = BLOCK + (
        "import pathlib, numpy as np\n"
        "from policies.formats import policy_file\n"
        "from policies.networks import delta_network, tree_arrays\n"
        "from policies.policy import load_policy\n"
        "stored = policy_file.load_policy_checkpoint(pathlib.Path(sys.argv[1]))\n"
        "arrays = tree_arrays.tree_to_arrays(stored.params)\n"
        "tree_arrays.tree_from_arrays(stored.params, arrays, 'here')\n"
        "folder = pathlib.Path(sys.argv[2]) / 'again'\n"
        "policy_file.save_policy(folder, stored.params, stored.spec, seed=1)\n"
        "policy = load_policy(folder)\n"
        "state, image = np.zeros((2, 12)), np.zeros((2, 24, 32))\n"
        "action, _ = policy.act(policy.start(2), state, image, np.ones(2, bool))\n"
        "print(np.isfinite(action).all())\n"
    )
    done = run(script, checkpoint, tmp_path)
    assert (done.returncode, done.stdout) == (0, "True\n"), done.stderr


def test_the_blocker_blocks():
    assert "torch is blocked" in run(BLOCK + "import policies.formats.torch_twin").stderr


@pytest.mark.parametrize(
    "module", ["policies.policy", "policies.formats.checkpoint", "policies.formats.export"]
)
def test_the_doors_import_nothing_heavy(module):
    heavy = ("jax", "safetensors", *BLOCKED.split())
    script = f"import sys, {module}\nprint(sorted(set({heavy!r}) & set(sys.modules)))"
    assert run(script).stdout == "[]\n"
