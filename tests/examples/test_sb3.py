"""The example of Stable-Baselines3, where that is installed: from training to a judged file."""

import importlib.util
import warnings
from pathlib import Path

import numpy as np
import pytest

from eval.envs.gymnasium_env import RaceEnv
from policies.contract import contract_of
from policies.policy import load_policy

pytest.importorskip("stable_baselines3", reason="pip install 'diffracing-suite[sb3]'")


def test_what_it_exports_answers_as_its_model(tmp_path):
    path = Path(__file__).resolve().parents[2] / "examples" / "sb3_race.py"
    assert len(path.read_text().splitlines()) <= 70
    found = importlib.util.spec_from_file_location("sb3_race", path)
    assert found and found.loader
    example = importlib.util.module_from_spec(found)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found.loader.exec_module(example)
        policy = load_policy(example.main(tmp_path, 0.02, envs=2, rollout=8))
    assert contract_of(policy.spec) == RaceEnv(**example.SETTINGS).contract
    rows = np.ones((1, 12), np.float32), np.ones((1, 6, 8), np.float32)
    action, memory = policy.act(policy.start(1), *rows, np.ones(1, bool))
    assert action.shape == (1, 3) and memory[0, 0] == 1.0
