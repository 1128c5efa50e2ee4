"""Columns in other axes, units and shapes become ours; wrong mapping files are refused by key."""

from pathlib import Path

import numpy as np
import pytest

from eval.importers import import_log, mapping
from eval.importers.mapping_file import (
    MIXERS,
    UNITS,
    WIDTHS,
    Column,
    map_file,
    read_map,
    shipped_maps,
)
from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError
from tests.support import known_flight
from tests.support.imported import near
from tests.support.vehicles import PLAIN

HEAD = """
[time]
column = "t"
"""

POSE = """
[pos]
column = "p"
[quat]
column = "q"
order = "xyzw"
"""

GRAVITY = np.array([0.0, 0.0, 9.81])


def cells(values):
    return ["[" + " ".join(repr(float(v)) for v in row) + "]" for row in values]


def imported(tmp_path, mapping, columns, **options):
    """The log of a CSV with `columns` (texts) under `mapping`."""
    rows = [",".join(columns)]
    rows += [",".join(row) for row in zip(*columns.values(), strict=True)]
    (tmp_path / "log7.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "map.toml").write_text(HEAD + mapping)
    told = ImportOptions(map=tmp_path / "map.toml", **options)
    return import_log(tmp_path / "log7.csv", "table", told)


def parts(truth):
    return {
        "t": [repr(float(t)) for t in truth.time],
        "p": cells(truth.pos),
        "q": cells(truth.quat[:, [1, 2, 3, 0]]),
    }


@pytest.fixture(scope="module")
def truth():
    return known_flight.fly(np.arange(0, 4, 0.005))


def test_lists_in_cells_rates_and_accelerations_in_world_axes(tmp_path, truth):
    acc_w = np.einsum("tij,tj->ti", truth.rot, truth.acc) - GRAVITY
    columns = parts(truth) | {
        "w": cells(np.einsum("tij,tj->ti", truth.rot, truth.rate)),
        "a": cells(acc_w / 9.81),
        "u": cells(np.full((len(truth.time), 4), 0.5) * 65535),
    }
    mapping = (
        POSE
        + """
[rate]
column = "w"
axes = "world"
[acc]
column = "a"
unit = "g"
axes = "world"
gravity = "removed"
[pwm]
column = "u"
unit = "65535"
"""
    )
    log, findings = imported(tmp_path, mapping, columns)
    assert not [found for found in findings if found.status == "corrected"], "nothing to correct"
    near(log.pos_w, truth.pos, 1e-9)
    near(log.rate_b, truth.rate, 1e-6)
    near(log.acc_b, truth.acc, 1e-6)
    near(log.pwm, 0.5, 1e-12)


def test_a_thrust_in_newton_is_divided_by_the_nominal_mass(tmp_path, truth):
    columns = parts(truth) | {
        "w": cells(truth.rate),
        "f": [repr(0.5 * float(c)) for c in truth.thrust],
        "m": cells(truth.rate * 1e-3),
    }
    mapping = (
        POSE
        + """
[rate]
column = "w"
[cmd_thrust]
column = "f"
unit = "N"
[cmd_torque]
column = "m"
[about]
file = "info{number}.yaml"
mass = "mass"
"""
    )
    with pytest.raises(FlightLogError, match="the mass is unknown"):
        imported(tmp_path, mapping, columns)
    (tmp_path / "info7.yaml").write_text("motors: standard\nmass: 0.5\n")
    log, _ = imported(tmp_path, mapping, columns)
    near(log.thrust_cmd, truth.thrust, 1e-9)
    near(log.torque_cmd_b, truth.rate * 1e-3, 1e-12)
    assert log.about["beside"] == {"motors": "standard", "mass": 0.5} and log.about["mass"] == 0.5
    (tmp_path / "info7.yaml").write_text("integrator: euler\npartial: no\nmass: 0\n")
    with pytest.raises(FlightLogError, match="the mass is unknown"):
        imported(tmp_path, mapping, columns)
    other, _ = imported(tmp_path, mapping, columns, mass=0.5)
    assert other.integrator is None and not other.partial
    log, _ = imported(tmp_path, mapping, columns, vehicle=PLAIN)
    near(log.thrust_cmd, 0.5 * truth.thrust / PLAIN.mass, 1e-9)
    assert log.rate_cmd_b is None


def test_the_firmwares_mixer_turns_the_body_the_way_that_it_says():
    """Roll lifts the left motors, pitch (nose up) the front ones, yaw those that turn against it.

    M1 to M4 are front right, rear right, rear left, front left.
    """
    thrust, roll, pitch, yaw = MIXERS["crazyflie"].T
    assert list(thrust) == [1, 1, 1, 1]
    assert list(roll > 0) == [False, False, True, True]
    assert list(pitch > 0) == [True, False, False, True]
    assert list(yaw > 0) == [True, False, True, False]
    column = Column(("thrust", "roll", "pitch", "yaw"), (1.0,) * 4, mixer="crazyflie")
    asked = np.array([[0.5, 0.0, 0.0, 0.0], [1.2, 0.0, 0.0, 0.0], [-0.2, 0.0, 0.0, 0.0]])
    motors = mapping._in_log_unit((np.arange(3.0), asked), column, "log")[1]
    np.testing.assert_allclose(motors, [[0.5] * 4, [1.0] * 4, [0.0] * 4])


def test_a_pose_is_taken_from_where_it_is_asked(tmp_path, truth):
    columns = parts(truth) | {"e": cells(truth.pos + 1.0), "w": cells(truth.rate)}
    columns["u"] = cells(np.full((len(truth.time), 4), 0.5))
    mapping = """
[[pos]]
column = "p"
source = "mocap"
[[pos]]
column = "e"
source = "estimate"
[quat]
column = "q"
order = "xyzw"
[rate]
column = "w"
[pwm]
column = "u"
"""
    log, _ = imported(tmp_path, mapping, columns)
    near(log.pos_w, truth.pos, 1e-9)
    log, _ = imported(tmp_path, mapping, columns, source="estimate")
    near(log.pos_w, truth.pos + 1.0, 1e-9)


@pytest.mark.parametrize(
    ("cell", "reason"), [("[1 2 x]", "is not a list"), ("[1 2]", "a list of 2 numbers")]
)
def test_a_broken_list_is_refused_by_row(tmp_path, truth, cell, reason):
    columns = parts(truth)
    columns["p"][4] = cell
    with pytest.raises(FlightLogError, match=f"column p, row 5: .*{reason}"):
        imported(tmp_path, POSE, columns, partial=True)


@pytest.mark.parametrize(("cell", "count"), [("1.0", 1), ("[1 2]", 2)])
def test_cells_that_hold_too_few_numbers_for_a_signal_are_refused(tmp_path, truth, cell, count):
    columns = parts(truth) | {"p": [cell] * len(truth.time)}
    with pytest.raises(FlightLogError, match=f"column p: {count} a row .* 3 numbers; give 3 col"):
        imported(tmp_path, POSE, columns, partial=True)


def test_the_first_time_that_is_there_counts(tmp_path, truth):
    again = HEAD.replace("[time]", '[[time]]\ncolumn = "stamp"\n[[time]]')
    assert again != HEAD
    (tmp_path / "map.toml").write_text(again + POSE)
    columns = parts(truth)
    rows = [",".join(columns), *(",".join(row) for row in zip(*columns.values(), strict=True))]
    (tmp_path / "log.csv").write_text("\n".join(rows))
    told = ImportOptions(map=tmp_path / "map.toml", partial=True)
    log, _ = import_log(tmp_path / "log.csv", "table", told)
    assert log.duration_s == pytest.approx(truth.time[-1] - truth.time[0], abs=0.02)


def test_every_shipped_mapping_is_read_by_its_name():
    assert {"nanobench", "crazypad", "crazyswarm2", "crazyflie"} <= set(shipped_maps())
    for name in shipped_maps():
        told = read_map(Path(name))
        assert told.motor_side is not None
        for signal, alternatives in told.columns.items():
            assert signal in UNITS
            for column in alternatives:
                assert len(column.factor) == WIDTHS[signal]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('[pos]\ncolumn = "a"\nunit = "feet"', "pos.unit is 'feet', allowed is 'm' or 'cm'"),
        ('[frames]\nworld = "enu"', "frames.world is 'enu'"),
        ('[rate]\ncolumn = "a"\nsign = [1, -2, 1]', "1 or -1"),
        ("[volts]", "key 'volts' at the top is unknown. Did you mean 'voltage'"),
        ('[vel]\ncolumn = "a"\naxis = "body"', "Did you mean 'axes'"),
        ("[time", "is not TOML"),
        ('[pwm]\ncolumns = ["a", "b", "c"]', "pwm.columns .* 4 column names"),
        ('[pwm]\ncolumn = "a"\nmixer = "x"', "pwm.mixer is 'x', allowed is 'crazyflie'"),
        ('[acc]\ncolumn = "a"\naxes = "ned"', "acc.axes is 'ned', allowed is 'body' or 'world'"),
        ('[pos]\ncolumn = "a"\nsource = "gps"', "pos.source is 'gps', allowed is 'mocap'"),
        ('[pos]\ncolumn = "a"\nscale = -1.0', "pos.scale is -1.0"),
        ("[frames]\nmotors = [[1, 1]]", "frames.motors"),
        ("[frames]\nmotors = [[1, 1], [0, 0], [1, -1], [-1, -1]]", "motors is .*off the middle"),
        ('[about]\nfile = "{log}.yaml"', "about.file is '{log}.yaml'.*but {stem} and {number}"),
        ('[about]\nfile = "{stem.yaml"', "about.file is .*but {stem} and {number}"),
        ('keep = ["flight"]', "keep is .*not a flight log's own, as 'flight' is"),
        ('keep = ["other", "motor_1"]', "keep is .*not a flight log's own, as 'motor_1' is"),
        ('optional = "maybe"', "optional is 'maybe', allowed is 'no' or 'yes'"),
    ],
)
def test_a_wrong_mapping_is_refused_by_key(tmp_path, text, reason):
    path = tmp_path / "map.toml"
    path.write_text(text + "\n")
    with pytest.raises(ValueError, match=reason):
        read_map(path)


def test_an_unknown_name_is_refused_with_the_names_there_are():
    with pytest.raises(ValueError, match="nanobench"):
        read_map(Path("nanobank"))
    for path in ("nanobank.toml", "folder/nanobank"):
        assert map_file(Path(path)) == Path(path), "a file, which may be missing"
