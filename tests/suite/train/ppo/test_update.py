"""An iteration of PPO."""

from dataclasses import replace

import pytest

from suite.train.ppo.config import ppo_like
from suite.train.ppo.update import make_update
from tests.support.training import small_config

DELAYS = {"image_delay": 2, "state_delay": 1, "depth_noise": 0.02}
CONFIG = replace(
    ppo_like(small_config(4, 6, physics=DELAYS, image_stride=2), iterations=3),
    epochs=2, minibatches=2, critic_epochs=2, critic_size=8,
)  # fmt: skip


@pytest.mark.parametrize("wrong", [{"minibatches": 3}, {"minibatches": 0}])
def test_minibatches_that_do_not_divide_the_batch_are_refused(wrong):
    with pytest.raises(ValueError, match=r"minibatches is \d, allowed are divisors .*\(4\)"):
        make_update(replace(CONFIG, **wrong))
