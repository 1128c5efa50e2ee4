"""The example that docs/policies.md points to runs and says what it should."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "bring_your_own_policy.py"


def test_the_example_runs_and_is_short(tmp_path):
    assert len(EXAMPLE.read_text().splitlines()) < 60
    command = [sys.executable, str(EXAMPLE), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    said = "to_the_gate.pt2 at 50 Hz: action ["
    assert done.stdout.startswith(said)
    action = done.stdout.removeprefix(said).partition("]")[0].split(", ")
    assert [round(float(x), 4) for x in action] == [4.8, 3.6, 0.0]
