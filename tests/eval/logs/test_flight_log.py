"""Flight logs come back as they were written; velocity is derived where it is missing."""

from dataclasses import replace

import numpy as np
import pyarrow.csv
import pyarrow.parquet
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from eval.logs import flight_log
from eval.logs.velocity import velocity_from_position
from tests.support.flights import small_track, smooth_flight
from tests.support.log_tables import KINDS, assert_same, columns, level, write_table


@pytest.mark.parametrize("kind", KINDS)
def test_our_flight_round_trips_bit_for_bit_with_its_extras(tmp_path, kind):
    flight = smooth_flight(small_track())
    log = flight_log.log_from_flight(flight)
    path = flight_log.write_flight(tmp_path / f"a.{kind}", log)
    back = flight_log.read_flight(path)
    assert_same(log, back)
    assert back.name == str(path) and not back.warnings and not back.velocity_derived
    state = ("time_s", "pos_w", "quat_wxyz", "vel_w", "rate_b")
    for name in (*state, "action_b", "policy_step", "gate"):
        np.testing.assert_array_equal(getattr(back, name), getattr(flight, name), err_msg=name)
    assert back.about["track"] == "zigzag" and back.about["seed"] == 5
    assert {"schema", "suite_version", "git_commit"} <= set(back.about)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_how_a_simulator_stepped_comes_back_and_nothing_is_made_up(tmp_path):
    log = flight_log.log_from_flight(smooth_flight(small_track()))
    assert log.integrator is None and log.step_s is None
    said = replace(log, about={**log.about, "integrator": "euler", "step_s": 0.002})
    back = flight_log.read_flight(flight_log.write_flight(tmp_path / "a.parquet", said))
    assert (back.integrator, back.step_s) == ("euler", 0.002)
    for odd in ({"integrator": 4, "step_s": "fine"}, {"step_s": 0.0}, {"step_s": True}):
        assert (replace(log, about=odd).integrator, replace(log, about=odd).step_s) == (None, None)


@pytest.mark.parametrize("kind", KINDS)
def test_a_golden_file_written_by_hand_reads_as_it_says(tmp_path, kind):
    csv = (
        "time, pos_x,pos_y,pos_z,quat_w,quat_x,quat_y,quat_z,rate_x,rate_y,rate_z,"
        "motor_1,motor_2,motor_3,motor_4,temperature\n"
        "10.00,0,1,2,1,0,0,0,0.1,,-0.1,900,901,902,903,20\n"
        "10.50,0.5,1,2,1,0,0,0,0.1,NaN,-0.1,900,901,902,903,\n"
        ",9,9,9,1,0,0,0,0,0,0,900,901,902,903,21\n"
        "11.25,1.25,1,2,0.7071,0.7071,0,0,0.1,0.2,-0.1,900,901,902,903,22\n"
    )
    path = tmp_path / "golden.csv"
    path.write_text("\ufeff" + csv)
    if kind == "parquet":
        table = pyarrow.csv.read_csv(path)
        table = table.rename_columns([name.strip() for name in table.column_names])
        path = tmp_path / "golden.parquet"
        pyarrow.parquet.write_table(table, path)
    log = flight_log.read_flight(path)
    np.testing.assert_array_equal(log.time_s, [10, 10.5, 11.25])
    np.testing.assert_array_equal(log.pos_w, [[0, 1, 2], [0.5, 1, 2], [1.25, 1, 2]])
    np.testing.assert_allclose(log.quat_wxyz[2], np.sqrt([0.5, 0.5, 0, 0]), rtol=1e-12)
    np.testing.assert_array_equal(log.rate_b[:, 1], [np.nan, np.nan, 0.2])
    assert log.rotor_speed is not None and log.thrust_cmd is None
    np.testing.assert_array_equal(log.rotor_speed[0], [900, 901, 902, 903])
    assert log.velocity_derived
    np.testing.assert_allclose(log.vel_w, [[1, 0, 0]] * 3, atol=1e-9)
    np.testing.assert_array_equal(log.whole, [False, False, True])
    np.testing.assert_array_equal(log.extra["temperature"], [20, np.nan, 22])
    assert log.warnings[0].startswith(f"{path}: 1 rows without a time are left out")
    assert "seconds" in log.warnings[1] and log.duration_s == 1.25


def test_rot_w_is_body_to_world():
    log = flight_log.log_from_columns(columns(), {}, "a")
    expected = Rotation.from_quat(log.quat_wxyz, scalar_first=True).as_matrix()
    np.testing.assert_allclose(log.rot_w, expected, atol=1e-12)


def test_one_bad_flight_among_many_is_named_and_all_bad_is_an_error(tmp_path):
    good = write_table(tmp_path / "good.csv", columns())
    bad = tmp_path / "bad.csv"
    bad.write_text("time\n1\n")
    flights, warnings = flight_log.read_flights([good, bad, good])
    assert [flight.name for flight in flights] == [str(good)] * 2
    assert len(warnings) == 1 and str(bad) in warnings[0] and "pos_x" in warnings[0]
    worse = bad.with_name("worse.csv")
    worse.write_bytes(bad.read_bytes())
    with pytest.raises(flight_log.FlightLogError, match="none can be used") as caught:
        flight_log.read_flights([bad, worse])
    assert str(bad) in str(caught.value) and len(str(caught.value).splitlines()) == 3, "a line each"
    with pytest.raises(flight_log.FlightLogError, match="no file"):
        flight_log.read_flights([])


def test_a_partial_log_lists_what_it_lacks_and_another_entry_makes_none():
    lacking = {name: v for name, v in columns().items() if not name.startswith(("pos", "quat"))}
    for listed in (["pos"], ["pos", "quat"]):
        log = flight_log.log_from_columns(lacking, {"partial": listed}, "a")
        assert log.partial == ("pos", "quat")
    assert flight_log.log_from_columns(columns(), {"partial": ["pos"]}, "a").partial == ()
    for entry in (True, "pos", {"pos": 1}):
        with pytest.raises(flight_log.FlightLogError, match="pos_x: missing"):
            flight_log.log_from_columns(lacking, {"partial": entry}, "a")


def test_a_row_that_lacks_a_torque_is_not_whole():
    torque = np.array([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0], [0.0, 0.0, 0.0]])
    thrust_cmd = np.array([9.0, 9.0, np.nan])
    log = level(np.arange(3.0), thrust_cmd=thrust_cmd, torque_cmd_b=torque)
    np.testing.assert_array_equal(log.whole, [True, False, False])


def test_derived_velocity_follows_a_racing_flight_over_jitter_and_holes(tmp_path):
    rng = np.random.default_rng(3)
    flight = smooth_flight(small_track(8), speed=6.0)
    keep = rng.random(len(flight.time_s)) > 0.1
    keep[100:112] = False
    table = flight_log.columns_from_log(replace(flight_log.log_from_flight(flight), extra={}))
    table = {name: values[keep] for name, values in table.items() if not name.startswith("vel")}
    table["pos_x"][20] = np.nan
    log = flight_log.log_from_columns(table, {}, "a")
    assert log.velocity_derived
    error = np.linalg.norm(log.vel_w - flight.vel_w[keep], axis=1)
    # A spline's jerk steps at its knots, up to 400 m/s^3 here, which a cubic cannot follow.
    assert np.median(error) < 0.02 and error.max() < 0.5
    back = flight_log.read_flight(flight_log.write_flight(tmp_path / "a.parquet", log))
    assert back.velocity_derived
    np.testing.assert_array_equal(back.vel_w, log.vel_w)


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), rate=st.sampled_from([20, 100, 500]))
def test_derived_velocity_of_a_cubic_is_exact_at_any_sampling(seed, rate):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.5, 1.5, 2 * rate)) / rate
    curve = np.polynomial.Polynomial(rng.normal(size=4) * [1e4, 5, 3, 1])
    pos = np.stack([curve(time), -curve(time), np.ones(len(time))], axis=1)
    slope = curve.deriv()(time)
    expected = np.stack([slope, -slope, np.zeros(len(time))], axis=1)
    np.testing.assert_allclose(velocity_from_position(time, pos), expected, atol=1e-5)


def test_derived_velocity_where_little_is_known():
    time = np.array([0.0, 1.0, 1.01, 5.0, 9.0])
    pos = np.stack([3 * time, 0 * time, 0 * time], axis=1)
    pos[1] = np.nan
    velocity = velocity_from_position(time, pos)
    assert np.isnan(velocity_from_position(time, np.full((5, 3), np.nan))).all()
    np.testing.assert_allclose(velocity[:, 0], 3.0)


TIME = np.arange(150) * 0.01


def made(**changed):
    """Return a log that a program makes of arrays, at rest for 1.5 s."""
    zeros = np.zeros((len(TIME), 3))
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(TIME), 1))
    log = flight_log.FlightLog("made", TIME, zeros, quat, zeros, zeros, TIME + 9.81, zeros)
    return replace(log, **changed)


@pytest.mark.parametrize(
    ("field", "values", "said"),
    [
        ("pos_w", np.zeros((3, 150)), r"`pos_w` is float64 of shape \(3, 150\), .* \(T, 3\)$"),
        ("quat_wxyz", np.zeros((150, 3)), r"`quat_wxyz` is .* of shape \(T, 4\)$"),
        ("thrust_cmd", 9.81, r"`thrust_cmd` is float64 of shape \(\), .* of shape \(T,\)$"),
        ("thrust_cmd", np.ones((150, 4)), r"of shape \(150, 4\), allowed are .* \(T,\)$"),
        ("pos_w", np.zeros((150, 3), complex), "`pos_w` is complex128"),
        ("time_s", (TIME * 1e9).astype("m8[ns]"), r"`time_s` is timedelta64\[ns\]"),
        ("rate_b", np.zeros((149, 3)), "rate_x: 149 values, but `time` has 150$"),
        ("extra", {"pos_x": TIME}, "pos_x: allowed in `extra` are texts that are no column"),
        ("extra", {3: TIME}, "column 3: allowed in `extra`"),
        ("extra", {"a": 3.0}, r"column a: shape \(\)"),
        ("extra", {"a": np.zeros((150, 2))}, r"column a: shape \(150, 2\)"),
        ("extra", None, "log.extra is None, allowed is a dict"),
        ("about", None, "log.about is None, allowed is a dict"),
    ],
)
def test_arrays_of_another_shape_or_type_than_their_field_are_refused(
    tmp_path, field, values, said
):
    with pytest.raises(ValueError, match=said):
        flight_log.write_flight(tmp_path / "a.parquet", made(**{field: values}))
    empty = {name: np.zeros((0, 3)) for name in ("pos_w", "vel_w", "rate_b", "rate_cmd_b")}
    empty |= {"time_s": TIME[:0], "thrust_cmd": TIME[:0], "quat_wxyz": np.zeros((0, 4))}
    with pytest.raises(flight_log.FlightLogError, match="no rows"):
        flight_log.write_flight(tmp_path / "a.parquet", made(**empty))
    assert not list(tmp_path.iterdir())


def test_masked_values_are_missing_and_a_column_of_one_is_a_vector(tmp_path):
    pos_w = np.ma.masked_array(np.ones((150, 3)), np.arange(450).reshape(150, 3) == 4)
    log = made(pos_w=pos_w, thrust_cmd=TIME[:, None])
    back = flight_log.read_flight(flight_log.write_flight(tmp_path / "a.parquet", log))
    assert np.argwhere(np.isnan(back.pos_w)).tolist() == [[1, 1]]
    np.testing.assert_array_equal(back.thrust_cmd, TIME)
