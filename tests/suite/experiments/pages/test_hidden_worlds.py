"""What the page on hidden worlds makes of loops: differences in pairs, laps, names."""

from suite.experiments.pages.hidden_worlds import Came, named_grid, rows_of
from suite.loop.hidden_effect import LABELS, NAMED
from tests.support.loops import EFFECT, WON, four_trials


def came(seed, won, named=True, world="a"):
    """Return a loop; one that names nothing has no fine-tuned policies."""
    names = LABELS if named else ("nominal", "before")
    found = {"effects": [EFFECT] if named else [], "verdict": "", "gap": {}}
    return Came(world, seed, {name: four_trials(won[name]) for name in names}, found, {})


def test_differences_are_in_pairs_and_count_no_loop_without_names():
    row, _ = rows_of(
        [came(0, WON), came(1, {**WON, NAMED: 2}), came(2, {**WON, "before": 0}, named=False)]
    )
    gap = row.gaps["named - control"]
    assert gap.of_seeds == [0.5, 0.0] and gap.difference.value == 0.25
    assert row.success["before"].value == 0.5 and row.loops == 3 and row.named == 2
    assert row.laps[NAMED] == (1.0, 6)
    assert row.laps["nominal"] == (1.0, 8)


def test_worlds_of_one_training_seed_add_no_trials():
    """They fly the same, and where nothing is hidden the same flights."""
    one, many = (
        rows_of([came(seed, WON, world=world) for seed in range(3) for world in worlds])[-1]
        for worlds in ("a", "ab")
    )
    assert many.loops == 6 and many.success == one.success
    assert many.gaps == one.gaps
    assert many.laps["nominal"] == (1.0, 24)


def test_a_gain_needs_three_seeds_that_agree_and_a_loop_with_names():
    def verdict(*loops):
        return {pair: gap.verdict for pair, gap in rows_of(loops)[0].gaps.items()}

    assert verdict(*(came(seed, WON) for seed in range(3)))["named - control"] == "gain"
    assert verdict(*(came(seed, WON) for seed in range(2)))["named - control"] == "unclear"
    worse = verdict(*(came(seed, {**WON, NAMED: 0}) for seed in range(3)))
    assert worse["named - control"] == "loss"
    assert verdict(came(0, WON, named=False)) == {}


def test_what_is_named_is_told_in_as_many_digits_as_mean_something():
    """Of a vector only what the flights can tell."""
    values = {"offset": {"value": [0.012001345, None], "ci95": None, "unit": "m"}}
    found = {
        "effects": [{"name": "com_offset", "alternatives": [], "parameters": values}],
        "verdict": "named",
        "gap": {"before": 7.123, "after": 1.0, "noise_floor": 1.0},
    }
    ((*_, named, told, gap),) = named_grid([Came("a", 0, {}, found, {})], {"a": "moved"}).rows
    assert named.text == "com_offset" and gap.text == "7.12, 1.00, 1.00"
    assert told.text == "com_offset offset 1 [m]: 0.012"
