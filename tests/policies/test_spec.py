"""What a policy asks of the world."""

from dataclasses import replace

from policies.spec import PolicySpec
from tests.policies.conftest import SPEC

SECOND = replace(SPEC, second_gate=True)
AXIS = replace(SPEC, gate_axis=True)
BOTH = replace(SECOND, gate_axis=True)


def test_the_paper_sees_one_gate_unless_asked():
    assert not PolicySpec().second_gate and PolicySpec().state_size == 12
    assert not PolicySpec().gate_axis and not PolicySpec().second_axis
    assert SECOND.state_size == AXIS.state_size == 15 and BOTH.state_size == 18
