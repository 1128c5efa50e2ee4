"""Pilots that need no training, as policy files."""

import pytest

import policies.policy
from tests.support.pilots import Pursuit, Steady


@pytest.fixture
def pilots(monkeypatch, tmp_path):
    """Make the policy files `pursuit` and `diver`; the other ways to load stay."""
    made = {
        "pursuit": Pursuit(),
        "diver": Steady((0.0, 0.0, -8.0), name="diver"),
        "diver2": Steady((1.0, 0.0, -8.0), name="diver"),
    }
    files = {name: tmp_path / name for name in made}
    for name, file in files.items():
        file.write_text(name)
    load = policies.policy.load_policy

    def load_pilot(name, trust=False):
        known = {str(file): made[pilot] for pilot, file in files.items()}
        return known.get(str(name)) or load(name, trust)

    monkeypatch.setattr(policies.policy, "load_policy", load_pilot)
    return {name: str(file) for name, file in files.items()}
