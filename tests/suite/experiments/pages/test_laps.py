"""What the page on laps says of plans and policies."""

from eval.worlds.trial import TrialSpec
from suite.common.report import Picture
from suite.experiments.pages.laps import cell_table, failures, lead, worst_tracks
from suite.experiments.planning.search import Plan
from suite.experiments.study.beside import beside
from tests.support.laps import flown
from tracks.common.grid import Grid, markdown

TRIALS = [TrialSpec("ellipse", 9, 0), TrialSpec("zigzag", 0, 0), TrialSpec("zigzag", 0, 1)]


def made():
    """Return plans, their flights, a policy's, and its laps: 5 times, 3 times, and no plan."""
    best = {
        TRIALS[0]: flown(2.0, trial=TRIALS[0]),
        TRIALS[1]: flown(3.0, trial=TRIALS[1]),
        TRIALS[2]: flown(1.0, success=False, trial=TRIALS[2]),
    }
    mine = {
        TRIALS[0]: flown(10.0, circles_at=4, trial=TRIALS[0]),
        TRIALS[1]: flown(9.0, trial=TRIALS[1]),
        TRIALS[2]: flown(9.0, trial=TRIALS[2]),
    }
    plans = [Plan(t, [], r.time_s, r.success, r.ending, r.time_s) for t, (r, _) in best.items()]
    return plans, best, mine, [beside(best[trial], mine[trial]) for trial in TRIALS]


def test_cells_have_laps_and_ratios_where_both_finish():
    plans, _, _, laps = made()
    lines = markdown(cell_table(plans, {"p": laps})).strip().splitlines()[2:]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert [line[:2] for line in cells] == [["zigzag", "0"], ["ellipse", "9"], ["all", ""]]
    assert cells[0][2:] == [
        "3.00 [3.00, 3.00]", "1 of 2", "p", "2 of 2", "9.00", "3.00 [3.00, 3.00]", "1.00", "0 of 2",
    ]  # fmt: skip
    assert cells[1][7] == "5.00 [5.00, 5.00]" and cells[1][9] == "1 of 1"
    assert cells[2][3] == "2 of 3" and cells[2][7].startswith("4.00 [3.00, 5.00]")


def test_failures_and_the_lead_say_what_is_left_out():
    plans, _, _, laps = made()
    text = lead(plans, {"p": laps})
    assert "2 of 3 tracks have a lap" in text and "4.00 [3.00, 5.00] times as long" in text
    assert (
        "in 1 of them it goes around" in text and "5.00 times as long, in the others 3.00" in text
    )
    assert "zigzag 0 seed 1 (" in failures(plans)
    assert failures(plans[:2]) == "Every plan was flown to the end in MuJoCo; none is left out."


def test_the_worst_track_comes_first_and_is_drawn():
    _, best, mine, laps = made()
    _, grid, picture = worst_tracks(best, {"p": mine}, {"p": laps})
    assert isinstance(grid, Grid) and isinstance(picture, Picture)
    first = markdown(grid).splitlines()[2]
    assert "ellipse | 9 | 0 | 2.00 | 10.00 | 5.00" in first and "circles to gate 4" in first
    assert picture.png.startswith(b"\x89PNG") and "p (right)" in picture.caption


def test_a_policy_that_finishes_nothing_has_no_ratio_and_no_list():
    plans, best, _, _ = made()
    lost = {trial: flown(9.0, success=False, trial=trial) for trial in TRIALS}
    laps = {"p": [beside(best[trial], lost[trial]) for trial in TRIALS]}
    text = lead(plans, laps)
    assert "p finishes none of them" in text and "times as long" not in text
    assert worst_tracks(best, {"p": lost}, laps) == [
        "There is no track that a plan and a policy both finish."
    ]


def test_where_every_lap_goes_around_there_are_no_others():
    plans, _, _, laps = made()
    text = lead(plans[:1], {"p": laps[:1]})
    assert "takes 5.00 times as long." in text and "others" not in text
