"""What the page on hidden worlds makes of loops: differences in pairs, laps, sentences."""

from suite.experiments.pages.hidden_worlds import WORTH, Came, lead, named_grid, rows_of
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


def test_the_lead_says_what_gained_and_where_nothing_is_named_only_what_was_lost():
    said = lead(rows_of([came(seed, WON) for seed in range(3)]))
    assert "loops: 3. The diagnosis names something in 3 of 3. There 50 %" in said
    assert "The named effect gains in: a." in said and "loses" not in said
    few = lead(rows_of([came(seed, WON) for seed in range(2)]))
    assert "The named effect gains in: none." in few
    assert "with less than 3 seeds nothing is called one" in WORTH
    worse = lead(rows_of([came(seed, {**WON, NAMED: 0}) for seed in range(3)]))
    assert "The named effect gains in: none; loses in: a." in worse
    silent = lead(rows_of([came(0, WON, named=False)]))
    assert "in 0 of 1. There 50 %" in silent and silent.endswith("where nothing is hidden.")
    lost = came(1, {**WON, "before": 0}, named=False)
    assert "in 1 of 2. In those 50 %" in lead(rows_of([came(0, WON), lost]))


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
