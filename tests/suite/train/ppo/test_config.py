"""PPO shares worlds, dynamics and policy with the differentiable trainer, and nothing else."""

from dataclasses import replace

from suite.train.ppo.config import PpoConfig, ppo_like
from suite.train.presets import preset


def test_ppo_like_a_training_has_its_worlds_and_ppos_own_settings():
    config = replace(preset("swift-quad"), seed=4)
    found = ppo_like(config, iterations=7)
    for part in ("spec", "physics", "quadrotor", "loss", "episode", "seed"):
        assert getattr(found, part) == getattr(config, part), part
    own = PpoConfig()
    assert found.iterations == 7 and found.rate == own.rate and found.clip == own.clip


def test_what_is_shared_goes_back_to_the_same_training():
    config = replace(preset("paper"), seed=4)
    shared = ppo_like(config, iterations=7).shared
    assert shared == replace(config, optimizer=shared.optimizer)
    assert shared.optimizer.iterations == 7
