"""The error for a policy that is refused."""

import pytest

from policies.policy import load_policy
from policies.spec import PolicyError


def test_a_refusal_is_a_wrong_value_which_the_command_line_says_in_one_line():
    assert issubclass(PolicyError, ValueError)
    with pytest.raises(ValueError) as caught:
        load_policy("no-such-policy")
    assert type(caught.value) is PolicyError and "no-such-policy" in str(caught.value)
