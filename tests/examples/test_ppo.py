"""PPO in one file: at a small size its networks learn, and its file answers as they do."""

from pathlib import Path

import numpy as np
import torch

from eval.envs.gymnasium_env import RaceEnv
from policies.contract import contract_of
from policies.policy import load_policy
from tests.support.tools import program

PATH = Path(__file__).resolve().parents[2] / "examples" / "cleanrl_ppo.py"


def test_it_trains_and_what_it_exports_answers_as_its_agent(tmp_path, monkeypatch, capsys):
    example = program(PATH)
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
