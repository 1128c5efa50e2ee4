"""The inputs of a program from elsewhere, by their names and shapes alone."""

import pytest

from policies.formats.program_inputs import check_inputs
from policies.spec import PolicyError, PolicySpec

STATE, IMAGE = ("batch", 12), ("batch", 24, 32)


@pytest.mark.parametrize(
    ("shapes", "found"),
    [
        ({"state": STATE, "image": IMAGE, "hidden": ("batch", 5)}, (64, (5,))),
        ({"state": STATE, "image": IMAGE}, (64, (0,))),
        ({"state": (7, 12), "image": (7, 24, 32), "hidden": ("n", 2, 3)}, (7, (2, 3))),
        ({"state": (1, "any"), "image": (1, "height", "width")}, (1, (0,))),
    ],
)
def test_rows_and_memory_are_told_by_the_shapes(shapes, found):
    assert check_inputs(shapes, PolicySpec(), "here") == found


@pytest.mark.parametrize(
    ("shapes", "said"),
    [
        ({}, "inputs are none; expected state, image, hidden in this order"),
        ({"image": IMAGE, "state": STATE}, "inputs are image, state; expected state, image"),
        ({"state": (2, 12), "image": (3, 24, 32)}, "all need the batch as first axis"),
        ({"state": STATE, "image": IMAGE, "hidden": ("batch", "n")}, "must be fixed"),
        ({"state": STATE, "image": IMAGE, "hidden": ("batch",)}, "must be fixed"),
        ({"state": ("batch", 15), "image": IMAGE}, r"'state' .* expected \(batch, 12\)"),
        ({"state": STATE, "image": ("batch", 32, 24)}, r"'image' .* expected \(batch, 24, 32\)"),
        ({"state": STATE, "image": ("batch", 768)}, r"expected \(batch, 24, 32\)"),
    ],
)
def test_what_is_no_observation_is_refused(shapes, said):
    with pytest.raises(PolicyError, match=f"^here: .*{said}"):
        check_inputs(shapes, PolicySpec(), "here")


def test_the_spec_sets_the_states_size():
    wider = PolicySpec(second_gate=True, gate_axis=True)
    assert check_inputs({"state": ("batch", 18), "image": IMAGE}, wider, "here") == (64, (0,))
    with pytest.raises(
        PolicyError, match=r"expected \(batch, 18\); .* second_gate, gate_axis, second_axis, speed"
    ):
        check_inputs({"state": STATE, "image": IMAGE}, wider, "here")
