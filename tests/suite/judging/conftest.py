"""Pilots that need no training, as policy files."""

import pytest

import policies.policy
from policies.spec import PolicySpec
from tests.support.pilots import Pursuit, Steady
from tracks.geometry.camera import Camera

OTHER = PolicySpec(camera=Camera(width=36, height=20), speed_input=True)
"""Not what a vehicle's file says of its camera, and with a speed to be asked for."""


@pytest.fixture
def pilots(monkeypatch, tmp_path):
    """Make a policy file of each pilot; the other ways to load stay."""
    made = {
        "pursuit": Pursuit(),
        "diver": Steady((0.0, 0.0, -8.0), name="diver"),
        "diver2": Steady((1.0, 0.0, -8.0), name="diver"),
        "other": Steady((0.0, 0.0, -8.0), OTHER, name="other"),
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
