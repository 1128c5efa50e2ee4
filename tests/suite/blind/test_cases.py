"""The cases of a set: their numbers, and that sets share none."""

from collections import Counter

import pytest

from eval.effects import EFFECTS
from suite.blind.cases import SETS, draw_cases, draw_rotorpy_cases


def test_a_full_set_has_the_numbers_that_were_promised():
    cases = draw_cases(SETS["published"])
    kinds = Counter(case.kind for case in cases.values())
    assert kinds == {
        "single": 2 * len(EFFECTS),
        "null": 100,
        "outside": 40,
        "pair": 20,
        "blurred": 15,
        "separated": 15,
    }
    singles = {(c.hidden[0], c.multiple) for c in cases.values() if c.kind == "single"}
    assert singles == {(name, m) for name in EFFECTS for m in (2.0, 6.0)}
    outside = {case.hidden[0] for case in cases.values() if case.kind == "outside"}
    assert len(outside) >= 6
    blurred = sorted((c.seed, c.hidden) for c in cases.values() if c.kind == "blurred")
    apart = sorted((c.seed, c.hidden) for c in cases.values() if c.kind == "separated")
    assert blurred == apart, "the same pairs with the same truth"


def test_sets_repeat_by_seed_and_do_not_share_cases():
    tuning, published = draw_cases(SETS["tuning"]), draw_cases(SETS["published"])
    assert tuning == draw_cases(SETS["tuning"])
    assert not {c.seed for c in tuning.values()} & {c.seed for c in published.values()}
    few = Counter(case.kind for case in draw_cases(1, 12).values())
    assert len(few) == 6 and sum(few.values()) < 20
    with pytest.raises(ValueError, match="count"):
        draw_cases(1, 0)
    assert {case.simulator for case in draw_rotorpy_cases(1).values()} == {"rotorpy"}
