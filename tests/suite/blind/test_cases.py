"""The cases of a set: their numbers, and that sets share none."""

from collections import Counter

import pytest

from eval.effects import EFFECTS, nameable_effects
from suite.blind.cases import DRAWERS, MULTIPLES, SETS, draw_cases, draw_continuous_cases


def test_a_full_set_has_the_numbers_that_were_promised():
    cases = draw_cases(SETS["published"])
    kinds = Counter(case.kind for case in cases.values())
    others = {"null": 100, "outside": 40, "pair": 20, "blurred": 15, "separated": 15}
    assert kinds == {"single": 2 * len(nameable_effects()), **others}
    singles = {(c.hidden[0], c.multiple) for c in cases.values() if c.kind == "single"}
    assert singles == {(name, m) for name in nameable_effects() for m in (2.0, 6.0)}
    outside = {case.hidden[0] for case in cases.values() if case.kind == "outside"}
    assert len(outside) >= 6
    blurred = sorted((c.seed, c.hidden) for c in cases.values() if c.kind == "blurred")
    apart = sorted((c.seed, c.hidden) for c in cases.values() if c.kind == "separated")
    assert blurred == apart, "the same pairs with the same truth"


def test_the_continuous_set_has_its_numbers_and_each_single_effect_once():
    cases = draw_continuous_cases(SETS["published"])
    kinds = Counter(case.kind for case in cases.values())
    assert kinds == {"null": 24, "single": 22, "pair": 10, "outside": 4}
    singles = [case for case in cases.values() if case.kind == "single"]
    assert len({case.hidden for case in singles}) == 22
    assert Counter(case.multiple for case in singles) == {m: 11 for m in MULTIPLES}
    assert {case.simulator for case in cases.values()} == {"continuous"}
    assert not any("hysteresis" in case.hidden for case in cases.values())


@pytest.mark.parametrize("simulator", DRAWERS)
def test_a_few_cases_are_of_every_kind_and_none_of_an_effect_that_no_flight_can_tell(
    simulator, monkeypatch
):
    draw = DRAWERS[simulator]
    whole = Counter(case.kind for case in draw(1, None).values())
    for count in (1, 12):
        few = Counter(case.kind for case in draw(1, count).values())
        share = count / whole.total()
        assert few == {kind: max(round(share * n), 1) for kind, n in whole.items()}
    assert draw(1, whole.total()) == draw(1, 10**5) == draw(1, None)
    with pytest.raises(ValueError, match="count = 0: must be at least 1"):
        draw(1, 0)
    # Sets that are published stay what they are, whatever such effects the catalogue gains.
    cases = draw(SETS["published"], None)
    assert "slung_load" in EFFECTS and "slung_load" not in nameable_effects()
    assert not any("slung_load" in c.hidden for c in cases.values() if c.kind != "outside")
    monkeypatch.delitem(EFFECTS._entries, "slung_load")
    assert "slung_load" not in EFFECTS and draw(SETS["published"], None) == cases


def test_no_two_simulators_and_no_two_sets_share_a_seed():
    seeds = [
        case.seed
        for draw in DRAWERS.values()
        for seed in SETS.values()
        for case in draw(seed, None).values()
        if case.kind != "separated"
    ]
    assert len(seeds) == len(set(seeds))
