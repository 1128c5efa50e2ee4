"""A small policy of ours as a checkpoint, for tests outside of policies/."""

from policies.formats.policy_file import save_policy
from tests.support.policy_files import SPEC, lively


def small_checkpoint(folder):
    """Write the checkpoint into `folder`/tiny and return its path."""
    return save_policy(folder / "tiny", lively(SPEC, 2), SPEC, seed=1)
