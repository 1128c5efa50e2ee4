"""A diagnosis as JSON, report and recording: what is said is what was found."""

import numpy as np
import pytest

from suite.common.report import html
from suite.diagnose.estimate.parameters import make_space
from suite.diagnose.report import charts
from suite.diagnose.report.charts import (
    black_box_chart,
    gains_chart,
    series_chart,
    write_rollouts,
)
from suite.diagnose.report.diagnosis_json import (
    actuators_json,
    black_box_json,
    diagnosis_json,
    parameters_json,
)
from suite.diagnose.report.page import channels_grid, page
from suite.diagnose.report.sections import (
    actuators_section,
    evidence_section,
    logs_section,
    noise_section,
    residual_section,
)
from suite.diagnose.report.summary import (
    NOT_IDENTIFIABLE,
    cells,
    components,
    grid,
    in_digits,
    short_name,
)
from suite.diagnose.verdict.actuators import actuator_mismatches
from suite.diagnose.verdict.black_box import BlackBoxComparison, BlackBoxComparisons
from tests.support.diagnosis_flights import fly
from tests.support.vehicles import PLAIN
from tracks.common.files import plain
from tracks.common.grid import Grid

PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def found(drag, flown):
    mismatches = actuator_mismatches(flown.logs, flown.vehicle)
    return plain(
        {**diagnosis_json(drag), "actuators": actuators_json(mismatches), "black_box": None}
    )


def texts(table):
    return [[cell.text for cell in row] for row in table.rows]


def compared(drag):
    gaps = (drag.main.before, drag.main.after, drag.main.before)
    side = BlackBoxComparison("flights left out", 9, 5, *gaps)
    return black_box_json(BlackBoxComparisons(side, None, 4.0, 1.0), 0)


def test_rows_are_cells_without_a_tone():
    assert [cell.text for cell in cells("a", "b")] == ["a", "b"] and not cells("a")[0].tone
    assert texts(grid("t", ["x"], [("1",), ("2",)], "n")) == [["1"], ["2"]]
    assert short_name("a\\b/c.parquet") == "c.parquet"


def test_the_json_says_what_was_found(drag, found):
    assert found["verdict"] == drag.label and found["driven_by"] == "commands"
    (effect,) = found["effects"]
    assert effect["name"] == "linear_drag" and effect["gap_removed"] > 0.9
    value = np.array(effect["parameters"]["coefficient"]["value"])
    np.testing.assert_allclose(value, drag.main.theta[drag.main.search.indices])
    assert found["gap"]["channels"]["1 s"]["velocity"]["noise_floor"] > 0.0
    assert found["actuators"][0]["followed"] > 0.9


def test_a_comparison_with_a_black_box_is_in_the_json(drag):
    box = compared(drag)
    assert box["outside"] is None and box["held_out"]["stretches"] == {"fitted": 9, "judged": 5}
    assert box["held_out"]["named"]["gap"] == drag.main.after.rms


def test_components_are_named_by_axis_and_shown_in_digits_that_the_interval_supports():
    entry = {"value": [0.012, 0.0004, None], "ci95": [[0.0119, 0.0121], [-0.001, 0.0018], None],
             "unit": "m"}  # fmt: skip
    x, y, z = components({"name": "com_offset", "parameters": {"offset": entry}})
    assert (x.label, x.texts()) == ("offset x [m]", ("0.01200", "0.01190 to 0.01210"))
    assert x.is_significant and not y.is_significant and not z.is_significant
    assert y.texts() == ("not different from 0", "-0.0010 to 0.0018")
    assert z.texts() == (NOT_IDENTIFIABLE, "")
    small = {"value": 1.21e-6, "ci95": [1.1e-6, 1.3e-6], "unit": "kg/rad"}
    (only,) = components({"name": "rotor_drag", "parameters": {"coefficient": small}})
    assert only.texts() == ("1.21e-06", "1.10e-06 to 1.30e-06")
    assert in_digits(1234.56, (1234.56, 1200.0, 1270.0)) == "1235"


def test_a_weak_motor_says_which_and_how_surely():
    space = make_space(PLAIN)
    at = [i for i, entry in enumerate(space.entries) if entry.effect == "weak_motor"]
    theta, width = space.array("start"), dict.fromkeys(at, 0.01)
    told = parameters_json(space, "weak_motor", [at[1]], theta, width, undecided=[at[2]])
    assert (told["index"]["value"], told["index"]["ci95"]) == (2, [2, 3])
    sure = parameters_json(space, "weak_motor", [at[1]], theta, width)
    assert sure["index"]["ci95"] == [2, 2]
    several = parameters_json(space, "weak_motor", [at[1], at[3]], theta, width)
    assert several["index"] == {"value": [2, 4], "unit": "1", "ci95": [[2, 2], [4, 4]]}
    labels = [one.label for one in components({"name": "weak_motor", "parameters": several})]
    assert labels == ["scale 2 [1]", "scale 4 [1]"]


def test_sections_show_the_numbers(drag, flown, found):
    logs = logs_section(flown.logs)
    assert isinstance(logs.parts[0], Grid) and len(logs.parts[0].rows) == 3
    noise = noise_section(drag).parts[1]
    assert isinstance(noise, Grid) and [row[0] for row in texts(noise)][0] == "position [m]"
    assert len(actuators_section(found)) == 1
    assert actuators_section({**found, "actuators": []}) == []
    rest = {**found, "unexplained": {"where": "a shape", "share": 0.25}}
    assert residual_section(rest).parts[0] == "25 % of the gap remains: a shape."
    held = evidence_section(drag, {**found, "black_box": compared(drag)}).parts
    assert "too few stretches" in str(held[-1])
    tables = [part for part in held if isinstance(part, Grid)]
    assert texts(tables[0])[-1][0] == "with the named effects" and len(tables) == 2


def test_the_facts_of_a_log():
    log = fly(PLAIN, 0, duration_s=3.0, motors=True)
    log.pos_w[30:60] = np.nan
    (row,) = texts(logs_section([log]).parts[0])
    assert row[1:6] == ["3.0 s", "301", "100 Hz", "10 ms", "10.0 %"]
    assert row[7] == "commands, velocity, rotor speeds"


def test_what_no_log_measured_is_not_in_the_table(found):
    none = {"before": 0.0, "after": 0.0, "noise_floor": 1e-12}
    every = found["gap"]["channels"].items()
    table = channels_grid({horizon: {**groups, "velocity": none} for horizon, groups in every})
    assert not any("velocity" in row[1] for row in texts(table)) and len(table.rows) > 3


def test_charts_are_pictures(drag, monkeypatch):
    main = drag.main
    scores = main.search.first
    assert gains_chart(scores, None, set()) != gains_chart(scores, 5.0, {"linear_drag"})
    assert black_box_chart([compared(drag)["held_out"]]).startswith(PNG)
    series = main.source.series(main.search)
    assert series_chart(series).startswith(PNG)
    drawn = lambda figure: figure.axes[0]  # noqa: E731
    monkeypatch.setattr(charts, "png", drawn)
    axes = series_chart(series)
    labels = [line.get_label() for line in axes.lines if not line.get_label().startswith("_")]
    assert labels == ["measured", *series.simulated] and len(series.simulated) == 2


def test_the_page_stands_alone(drag, found):
    text = html(page(drag, found, "name = 'x'", {"vehicle.toml"}))
    assert (
        text.count("<h2>") == 4
        and text.count('class="section"') >= 6
        and "linear_drag" in text
        and "vehicle.toml" in text
    )
    assert "recording.rrd" not in text


def test_the_recording_is_written(drag, flown, tmp_path):
    path = write_rollouts(tmp_path / "x.rrd", flown, drag.main.theta)
    assert path.stat().st_size > 10_000
