"""Trainers of examples/ at a small size: their files answer as their networks do."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from eval.envs.gymnasium_env import RaceEnv
from policies.contract import contract_of
from policies.policy import load_policy
from tests.support.tools import program

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.mark.extended
def test_ppo_in_one_file_trains_and_its_export_answers_as_its_agent(tmp_path, monkeypatch, capsys):
    example = program(EXAMPLES / "cleanrl_ppo.py")
    agents, kind = [], example.Agent
    monkeypatch.setattr(example, "Agent", lambda: agents.append(kind()) or agents[0])
    policy = load_policy(example.main(tmp_path, 0.0, envs=2, steps=12))
    said = capsys.readouterr().out
    assert said.startswith("24 decisions: ") and len(said.splitlines()) == 1
    (agent,) = agents
    torch.manual_seed(0)
    fresh = kind()
    assert all(
        not torch.equal(one, other)
        for one, other in zip(agent.parameters(), fresh.parameters(), strict=True)
    )
    assert contract_of(policy.spec) == RaceEnv(spec=example.SPEC).contract
    rng = np.random.default_rng(0)
    state, image = rng.normal(size=(1, 12)), rng.normal(size=(1, 8, 12))
    rows = state.astype(np.float32), image.astype(np.float32)
    action, _ = policy.act(policy.start(1), *rows, np.ones(1, bool))
    with torch.no_grad():
        own = agent(*map(torch.as_tensor, rows))
    np.testing.assert_allclose(action, own, atol=1e-5)


def test_what_stable_baselines_exports_answers_as_its_model(tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3", reason="pip install 'diffracing-suite[sb3]'")
    path = EXAMPLES / "sb3_race.py"
    assert len([line for line in path.read_text().splitlines() if line]) <= 60
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        example = program(path)
        made, export = [], example.export_module
        monkeypatch.setattr(
            example, "export_module", lambda *given: made.append(given[0]) or export(*given)
        )
        policy = load_policy(example.main(tmp_path, 0.02, envs=2, rollout=8))
    assert contract_of(policy.spec) == RaceEnv(**example.SETTINGS).contract
    (judged,) = made
    rng, memory, before = np.random.default_rng(0), policy.start(1), None
    for fresh in (True, False):  # the second decision sees the first one's frame as well
        rows = rng.normal(size=(1, 12)), rng.uniform(0.0, 2.0, (1, 6, 8))
        state, image = (row.astype(np.float32) for row in rows)
        action, memory = policy.act(memory, state, image, np.array([fresh]))
        seen = {"state": (state - judged.mean.numpy()) / judged.deviation.numpy()}
        seen = {"state": seen["state"].clip(-10.0, 10.0), "image": image.reshape(1, -1)}
        before = before or {key: np.zeros_like(part) for key, part in seen.items()}
        frames = {key: np.concatenate([before[key], seen[key]], -1) for key in seen}
        answer, _ = judged.policy.predict(frames, deterministic=True)
        np.testing.assert_allclose(action, answer, atol=1e-5)
        before = seen
