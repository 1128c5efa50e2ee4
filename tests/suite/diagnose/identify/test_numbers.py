"""From a log's rows to the numbers of a file: windows, drives, entries, and what is reported."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from eval.logs.flight_log import write_flight
from eval.quadrotor.loops import KINDS
from eval.quadrotor.plant import Command, make_plant
from eval.quadrotor.stepper import wanted_speed
from eval.vehicles.vehicle import MotorMap
from suite.common.console import Console
from suite.diagnose.identify import drive, entries, run
from suite.diagnose.identify.body import lag_unknowns
from suite.diagnose.identify.fit import Fitted
from suite.diagnose.identify.grid import ROTOR_NOISE, STEP_S, FlightGrid, grid_of
from suite.diagnose.identify.identify import PARTS, Identified, identify
from suite.diagnose.identify.numbers import Number, not_attempted, not_identified, number_lines
from suite.diagnose.identify.run import identify_files
from tests.support import identified as known
from tests.support.log_tables import level
from tests.support.vehicles import PLAIN, with_effects


def test_bumps_are_exact_on_lines_and_parabolas():
    time_s = STEP_S * np.arange(500)
    values = (3.0 + 2.0 * time_s + 5.0 * time_s**2)[:, None]
    flight = FlightGrid("made", time_s, {"x": values})
    form, path = (flight.form(0.2, ("x",), slope) for slope in (False, True))
    assert form.middle_s[0] >= 0.4
    slope = (form.change @ values)[:, 0]
    np.testing.assert_allclose(slope, 2.0 + 10.0 * form.middle_s, rtol=1e-3)
    np.testing.assert_allclose(path.change @ values, 10.0, rtol=1e-3)
    constant = np.full((500, 1), 7.0)
    np.testing.assert_allclose(path.mean @ constant, 0.0, atol=1e-9)
    np.testing.assert_allclose(form.mean @ constant, 7.0)
    np.testing.assert_allclose(path.mean @ time_s, 1.0, rtol=1e-3)


COUNT = 400
SECONDS, TIME = 0.01 * np.arange(COUNT), STEP_S * np.arange(COUNT)
logged = partial(level, SECONDS)


def test_a_command_counts_from_its_stamp_and_measurements_are_joined():
    rng = np.random.default_rng(0)
    time_s = np.concatenate([[0.0], np.cumsum(rng.uniform(0.004, 0.012, COUNT - 1))])
    pwm, rate_b = rng.standard_normal((COUNT, 4)), rng.standard_normal((COUNT, 3))
    flight = grid_of(level(time_s, pwm=pwm, rate_b=rate_b))
    assert not flight.has("voltage")
    for k in (0, 17, 100, 250):
        fine_s = STEP_S * (k + (np.arange(4000) + 0.5) / 4000)
        mean = pwm[np.searchsorted(time_s, fine_s, side="right") - 1].mean(axis=0)
        np.testing.assert_allclose(flight.signals["pwm"][k], mean, atol=2e-3)
        joined = [np.interp(flight.time_s[k], time_s, column) for column in rate_b.T]
        np.testing.assert_allclose(flight.signals["rate_b"][k], joined, atol=1e-9)


def in_turn(values):
    """Return values of which every row has one column only."""
    count, width = values.shape
    return np.where(np.arange(count)[:, None] % width == np.arange(width), values, np.nan)


def test_motors_that_are_logged_in_turn_are_each_taken_by_their_own_rows():
    ramp = np.add.outer(100.0 * SECONDS, [0.0, 10.0, 20.0, 30.0])
    flight = grid_of(logged(rotor_speed=in_turn(ramp), pwm=in_turn(np.full((COUNT, 4), 0.5))))
    assert flight.in_turn == ("rotor_speed", "pwm")
    wanted = np.add.outer(100.0 * flight.time_s, [0.0, 10.0, 20.0, 30.0])
    np.testing.assert_allclose(flight.signals["rotor_speed"][10:-10], wanted[10:-10])
    np.testing.assert_allclose(flight.signals["pwm"][10:-10], 0.5)
    assert grid_of(logged(rotor_speed=ramp)).in_turn == ()
    speed = in_turn(1000.0 + 8.0 * np.random.default_rng(0).standard_normal((COUNT, 4)))
    noise = grid_of(logged(rotor_speed=speed)).signals[ROTOR_NOISE]
    assert np.isfinite(noise[10:-10]).all()
    # On the grid it is joined by lines, which leaves two thirds of the variance.
    assert np.nanstd(noise) == pytest.approx(8.0 * np.sqrt(2.0 / 3.0), rel=0.15)


@pytest.mark.parametrize(
    ("name", "width"),
    [("pos_w", (3,)), ("vel_w", (3,)), ("rate_b", (3,)), ("rotor_speed", (4,)), ("pwm", (4,)),
     ("rate_cmd_b", (3,)), ("thrust_cmd", ()), ("voltage", ()), ("quat_wxyz", (4,))],
)  # fmt: skip
def test_a_signal_of_one_row_is_none(name, width):
    values = np.full((COUNT, *width), np.nan)
    values[0] = 0.5
    # Rates that are not logged are computed from the attitude.
    flat = np.full((COUNT, 4), np.nan)
    flight = grid_of(logged(**{"quat_wxyz": flat, name: values}))
    assert not flight.has({"quat_wxyz": "rot_w"}.get(name, name))


def test_what_is_late_by_less_than_nothing_is_early():
    ramp = TIME[:, None].copy()
    np.testing.assert_allclose(drive.delayed(ramp, -0.01)[10:-10], ramp[10:-10] + 0.008, atol=1e-12)
    np.testing.assert_allclose(drive.delayed(ramp, 0.01)[10:-10], ramp[10:-10] - 0.012, atol=1e-12)


def test_effects_of_the_start_act_on_the_torque():
    moved = with_effects(PLAIN, com_offset=((0.01, 0.0, 0.0),))
    flight = FlightGrid("made", TIME, {"rotor_speed": np.full((400, 4), 1000.0)})
    driven = drive.DrivenVehicle(moved, "rotors").accelerations({})
    _, turn_b = driven(flight, flight.rows(False))
    thrust = 4e6 * PLAIN.rotors.thrust_coefficient
    np.testing.assert_allclose(turn_b[0, 1], 0.01 * thrust / PLAIN.inertia[1], rtol=0.05)
    assert drive.unmodelled_effects(moved) == []


def test_motors_without_a_fit_are_those_of_the_file():
    begun = replace(PLAIN, motors=MotorMap((1.0, 6.0), 6.0, 1.3))
    found = drive.DrivenVehicle(begun, "pwm", 0.5, 8.0).motor_map({})
    np.testing.assert_allclose((*found.thrust, found.voltage_exponent), (1.0, 6.0, 1.3))


@pytest.mark.parametrize(
    ("begun", "with_volts", "without"),
    [
        # At full speed, and at the voltage of the flights if they have one.
        (None, ((0.0, PLAIN.rotors.thrust_max), 15.0, 1.0), None),
        # A nominal voltage counts only with an exponent.
        (((1.0, 4.0), 16.0, 0.0), ((1.0, 4.0), 15.0, 0.0), ((1.0, 4.0), 16.0, 0.0)),
        (((1.0, 4.0), 16.0, 1.2), ((1.0, 4.0), 16.0, 1.2), ((1.0, 4.0), 16.0, 1.2)),
    ],
)
def test_motors_begin_with_those_of_the_file_or_at_full_speed(begun, with_volts, without):
    vehicle = replace(PLAIN, motors=begun and MotorMap(*begun))
    pwm = {"pwm": np.full((400, 4), 0.5)}
    flight = FlightGrid("made", TIME, {**pwm, "voltage": np.full(400, 15.0)})
    assert drive.driven_vehicle([flight], vehicle, "pwm").start.motors == MotorMap(*with_volts)
    bare = drive.driven_vehicle([FlightGrid("made", TIME, pwm)], vehicle, "pwm").start.motors
    assert bare.voltage_exponent == 0.0 if without is None else bare == MotorMap(*without)


def test_flights_without_a_common_drive_or_a_scale_that_cannot_hover_are_refused_before_the_work():
    one = FlightGrid("one", TIME, {"pwm": np.zeros((400, 4))})
    other = FlightGrid("other", TIME, {"rotor_speed": np.zeros((400, 4))})
    assert drive.common_drive([one]) == "pwm"
    with pytest.raises(ValueError, match="share no drive"):
        drive.common_drive([one, other])
    weak = with_effects(PLAIN, thrust_scale=(0.3,))
    slow = replace(weak, rotors=replace(weak.rotors, speed_max=1500.0))
    with pytest.raises(ValueError, match="plain with its thrust_scale: .*too weak to hover"):
        drive.with_merged_effects(slow, True)
    assert drive.with_merged_effects(slow, False) == slow


def turn_b(vehicle):
    """The angular acceleration of a body at rest by its rate loop, for a small command."""
    plant, at_rest = make_plant(vehicle, 0.002), np.zeros(3)
    command = Command(np.asarray(9.81), np.array([0.3, -0.2, 0.1]))
    speed = np.tile(wanted_speed(plant, command, at_rest), (400, 1))
    flight = FlightGrid("made", TIME, {"rotor_speed": speed})
    return drive.DrivenVehicle(vehicle, "rotors").accelerations({})(flight, flight.rows(False))[1]


MERGED = {
    **{"motor_lag": (0.05,), "thrust_scale": (0.9,), "clock_offset": (0.01,)},
    **{"inertia_scale": ((1.2, 0.9, 1.1),), "rate_gain": ((0.8, 1.0, 1.3),)},
}


def test_effects_that_are_part_of_a_number_are_merged_and_the_vehicle_turns_as_before():
    before = with_effects(**MERGED)
    after = drive.with_merged_effects(before, True)
    assert list(after.effects) == ["clock_offset"] == list(drive.unmodelled_effects(after))
    old, new = (make_plant(vehicle, 0.002).constants for vehicle in (before, after))
    for name in ("inertia", "time_constant", "thrust_coefficient", "torque_coefficient"):
        np.testing.assert_allclose(getattr(new, name), getattr(old, name))
    np.testing.assert_allclose(turn_b(after), turn_b(before), rtol=1e-9)
    # A scale of the commanded thrust stays where no motor is known.
    commanded = drive.with_merged_effects(before, False)
    assert "thrust_scale" in commanded.effects
    np.testing.assert_allclose(turn_b(commanded), turn_b(before), rtol=1e-9)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_the_loop_of_a_firmware_keeps_its_settings_and_its_effect(kind):
    """Its gain has no key that the effect could be merged into; `rate_gain` is another loop's."""
    loop = replace(PLAIN.controller, kind=kind, settings=KINDS[kind].Settings())
    del (effects := dict(MERGED))["thrust_scale"]
    before = with_effects(replace(PLAIN, controller=loop), **effects)
    after = drive.with_merged_effects(before, True)
    assert list(after.effects) == ["clock_offset", "rate_gain"] and after.controller == loop
    np.testing.assert_allclose(turn_b(after), turn_b(before), rtol=1e-9)


@pytest.mark.parametrize(("driven_by", "gains"), [("rates", (25, 20, 8)), ("rotors", (20, 20, 8))])
def test_the_gain_in_the_file_allows_for_the_thrust_scale_there(driven_by, gains):
    """A thrust of 0.8 turns the body 0.8 times as fast, and a gain that is not seen stays."""
    axes = known.fitted(entries.GAINS, left=["gain_y"])
    (found,) = entries.entries_of(drive.DrivenVehicle(PLAIN, driven_by), axes, np.log(0.8))
    assert found.key == "controller.rate_gain"
    np.testing.assert_allclose(found.value, gains)


@pytest.mark.slow
def test_the_result_does_not_depend_on_how_the_start_gives_a_number():
    plain = known.start()
    same = with_effects(plain, inertia_scale=((0.9, 1.1, 1.0),))
    same = replace(same, inertia=tuple(np.divide(plain.inertia, (0.9, 1.1, 1.0)).tolist()))
    one, other = known.found("rotors").vehicle, identify(known.logs("rotors", 0)[::3], same).vehicle
    assert set(one.effects) == set(other.effects)
    np.testing.assert_allclose(other.inertia, one.inertia, rtol=1e-6)


DRAG = "effects.linear_drag.coefficient"


def test_the_inertia_about_z_follows_the_others():
    driven = drive.DrivenVehicle(PLAIN, "rotors")
    inertia = driven.vehicle({"inertia_x": 0.2, "inertia_y": 0.0}).inertia
    found = drive.possible_inertia(inertia)
    np.testing.assert_allclose(found[2], PLAIN.inertia[2] * np.exp(0.1))
    assert np.all(found <= found.sum() - found + 1e-15), "no body has one larger than both others"


def test_rotors_that_are_too_slow_to_hover_get_the_speed_that_they_flew_at():
    """1.6e-6 x 1000^2 = 1.6 N a rotor, of 1.84 N that are needed; one row is no speed."""
    speeds = [np.full((50, 4), 1100.0), np.full((60, 4), 1200.0), np.full((1, 4), 9e4)]
    slow = replace(PLAIN, rotors=replace(PLAIN.rotors, speed_max=1000.0))
    assert entries.with_reachable_speed(slow, speeds).rotors.speed_max == 1200.0
    assert entries.with_reachable_speed(PLAIN, speeds) == PLAIN


def test_identified_numbers_are_put_in_and_what_no_file_may_hold_is_noted():
    lag = Number("rotors.time_constant", "s", [0.05], [(0.04, 0.06)])
    assert entries.with_entries(PLAIN, [lag])[0].rotors.time_constant == 0.05
    assert entries.with_entries(PLAIN, [lag._replace(ci95=[None])])[0] == PLAIN
    spans = [(0.2, 0.4), (-0.2, 0.0), None]
    drag = Number(DRAG, "1/s", [0.3, -0.1, 0.0], spans)
    vehicle, (entry,), (note,) = entries.with_entries(PLAIN, [drag])
    assert vehicle.effects["linear_drag"].coefficient == tuple(entry.value) == (0.3, 0.0, 0.0)
    assert entry.ci95 == spans and note.startswith(f"{DRAG}[1]: these flights give -0.1")
    late = with_effects(PLAIN, command_delay=(0.03,), linear_drag=((0.1, 0.1, 0.1),))
    none = Number(entries.DELAY, "s", [-0.001], [(-0.002, 0.0)])
    vehicle, numbers, (note,) = entries.with_entries(late, [none])
    assert set(vehicle.effects) == {"linear_drag"} and numbers == []
    assert note.endswith("the file has none")
    assert entries.with_entries(late, [none._replace(ci95=[None])])[0] == late


@pytest.mark.parametrize(("half", "identified"), [(0.008, True), (0.009, False)])
def test_a_delay_is_no_better_known_than_the_lag_however_well_their_sum_is(half, identified):
    """The widest interval is +-12 ms: a sum within 8 ms minus a lag within 8 ms has 11.3 ms."""
    covariance = np.diag([half**2, half**2]) / 1.96**2
    unknowns = tuple(lag_unknowns(0.03, 0.04))
    fitted = Fitted(unknowns, np.array([0.05, 0.03]), covariance)
    _, delay = entries.entries_of(drive.DrivenVehicle(PLAIN, "pwm"), fitted)
    assert (delay.ci95 != [None]) == identified == (not delay.follows)
    vehicle = entries.with_entries(PLAIN, [delay])[0]
    assert vehicle.effects["command_delay"].delay == pytest.approx(0.02), "the file keeps the sum"
    negative = delay._replace(value=[-0.003])
    assert "command_delay" not in entries.with_entries(PLAIN, [negative])[0].effects


def test_what_one_fit_leaves_and_another_identifies_is_identified():
    torque = known.fitted(("lag", "late"), left=("lag", "late"))
    fitted = {"torque": torque, "loop": known.fitted(("lag",))}
    given = {entries.DELAY: Number(entries.DELAY, "s", [0.0], [None])}
    lines = not_identified(fitted, given, 0.0)
    assert [line.split(":")[0] for line in lines] == ["command_delay"]


@pytest.mark.parametrize(
    ("delay_s", "words"),
    [
        (0.0, "this sum minus the file's lag"),
        (-0.01, "the nearest allowed value to this sum minus the file's lag, -0.01 s"),
    ],
)
def test_a_sum_shorter_than_the_lag_is_not_said_to_be_in_the_file(delay_s, words):
    fitted = {"torque": known.fitted(("lag", "late"), left=("lag",))}
    given = {entries.DELAY: Number(entries.DELAY, "s", [delay_s], [None], True)}
    _, line = not_identified(fitted, given, 0.0)
    assert line.endswith(f"the file's delay, 0 s, is {words}")


COMPLETE = {"force": ("thrust", "drag_x"), "loop": ("gain_x",), "torque": ("inertia_x", "late")}


@pytest.mark.parametrize(
    ("drive", "without", "broken", "line"),
    [
        ("rates", "torque", "", "inertia and torque_coefficient: commanded rates and thrust"),
        ("rotors", "torque", "", "time_constant and command_delay: measured rotor speeds do not"),
        ("rotors", "torque", "rotors", "time_constant and command_delay: .* both measured and"),
        ("pwm", "force", "force", "thrust and drag: .* with both the path"),
        ("pwm", "torque", "torque", "inertia and torque_coefficient: .* with both body rates"),
        ("rates", "loop", "loop", "rate_gain: .* with both body rates and commanded ones"),
        ("pwm", "", "", None),
    ],
)  # fmt: skip
def test_what_has_no_column_or_never_both_is_reported(drive, without, broken, line):
    signals = dict.fromkeys(["voltage", "rotor_speed", "rate_b", "rate_cmd_b"], np.zeros(COUNT))
    flights = [FlightGrid("made", TIME, signals)]
    fitted = {name: known.fitted(of) for name, of in COMPLETE.items() if name != without}
    lines = not_attempted(flights, PLAIN, drive, fitted, [], [broken])
    assert lines == [] if line is None else any(re.match(line, text) for text in lines), lines


def test_parts_that_do_not_exist_and_nothing_but_parts_to_leave_are_refused(tmp_path):
    for leave, message in ((["wings"], f"allowed: {', '.join(PARTS)}"), (PARTS, "nothing remains")):
        with pytest.raises(ValueError, match=message):
            identify_files([tmp_path], "reference", tmp_path / "v.toml", leave, Console())


def test_numbers_that_no_file_may_hold_are_printed_with_the_refusal(tmp_path, monkeypatch):
    numbers = (Number("motors.thrust", "N", [9.0, -8.0], [(8.0, 10.0), None]),)
    weak = replace(PLAIN, motors=MotorMap((9.0, -8.0), 16.0))
    result = Identified(weak, numbers, ("the rest",), "pwm", {})
    monkeypatch.setattr(run, "identify", lambda *_: result)
    write_flight(tmp_path / "one.parquet", known.logs("rates", 0, known.HOVER)[0])
    out = tmp_path / "v.toml"
    with pytest.raises(ValueError, match="must grow with the command") as refused:
        identify_files([tmp_path / "one.parquet"], "reference", out, [], Console())
    assert "motors.thrust[0] = 9: 8 to 10 N\nnot identifiable: the rest" in str(refused.value)
    assert not out.exists()


def test_a_ratio_is_listed_without_a_unit():
    scale = Number("effects.thrust_scale.scale", "1", [0.98], [(0.97, 0.99)])
    mass = Number("mass", "kg", [0.75], [(0.7, 0.8)])
    assert number_lines([scale, mass]) == [
        "effects.thrust_scale.scale = 0.98: 0.97 to 0.99",
        "mass = 0.75: 0.7 to 0.8 kg",
    ]
