"""Signals and poses come onto one clock and the rows of one log; bad samples and ground time go."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eval.importers import import_log
from eval.importers.cleaning import airborne, clean, without_repeats
from eval.importers.options import ImportOptions
from eval.importers.pose import _in_seconds, align, with_pose
from eval.importers.rows import averaged, row_times, smoothed
from eval.importers.signals import Recording, Signal, make_signal, median_step
from eval.logs.columns import FlightLogError
from eval.logs.faults.reading import read_as
from tests.support import foreign_logs as made
from tests.support import known_flight
from tests.support.imported import flight, of, text, write
from tests.support.marks import more


def test_differing_rates_jitter_and_holes(tmp_path):
    rng = np.random.default_rng(1)
    time = np.cumsum(rng.uniform(0.003, 0.007, 1600))
    truth = known_flight.fly(time)
    parts = {"time": time, "pos": truth.pos, "quat": truth.quat, "rate": truth.rate}
    parts |= {"cmd_thrust": truth.thrust[:, None], "cmd_rate": truth.cmd_rate}
    every = np.arange(len(time))
    hole = (time > 3.0) & (time < 3.6)
    keep = {
        "pos": (every % 4 == 0) & ~hole,
        "quat": every % 2 == 0,
        "cmd_rate": every % 5 == 0,
        "cmd_thrust": every % 5 == 0,
    }
    log, findings = import_log(write(tmp_path / "log.csv", parts, keep))
    assert {"position", "rows"} <= of(findings, "note")
    at = log.time_s + time[0]
    np.testing.assert_allclose(at, time[keep["pos"]], atol=1e-9)
    found = known_flight.fly(at)
    np.testing.assert_allclose(log.pos_w, found.pos, atol=1e-9)
    np.testing.assert_allclose(log.rate_b, found.rate, atol=2e-3)
    # A derived velocity is not there beside the hole.
    assert log.velocity_derived
    clear = (at < 2.9) | (at > 3.8)
    np.testing.assert_allclose(log.vel_w[clear], found.vel[clear], atol=0.1)


@pytest.mark.parametrize(("pos", "quat", "vel"), [(4, 1, 8), more(10, 5, 10), more(2, 3, 2)])
def test_a_measurement_is_in_one_row_only(tmp_path, pos, quat, vel):
    """Values copied to rows between them would look like less noise than there is."""
    good = flight(noise=1.0)
    every = np.arange(len(good["time"]))
    keep = {"pos": every % pos == 0, "quat": every % quat == 1 % quat, "vel": every % vel == 0}
    log, _ = import_log(write(tmp_path / "log.csv", good, keep))
    for name, value in (("pos", log.pos_w), ("quat", log.quat_wxyz), ("vel", log.vel_w)):
        count = np.isfinite(value[:, 0]).sum()
        assert count <= keep[name].sum() and count > 0.9 * min(keep[name].sum(), len(value))
    both = (every % np.lcm(pos, vel) == 0).sum()
    assert log.whole.sum() > 0.9 * min(both, len(log.time_s))
    # Slower than 20 Hz only with rows between.
    assert 1 / np.median(np.diff(log.time_s)) > 19.0


def test_faster_signals_are_smoothed_and_commands_hold_their_mean(tmp_path):
    parts = flight(hz=1000.0, end=6.0)
    shake = 5.0 * np.sin(2 * np.pi * 240.0 * parts["time"])[:, None]
    parts["rate"] = parts["rate"] + shake
    path = write(tmp_path / "log.csv", parts)
    log, _ = import_log(path, None, ImportOptions(rate_hz=50.0))
    truth = known_flight.fly(log.time_s)
    assert len(log.time_s) == 300
    assert np.abs(log.rate_b - truth.rate)[2:-2].max() < 1.0
    middle = known_flight.fly(log.time_s + 0.0095).cmd_rate
    np.testing.assert_allclose(np.asarray(log.rate_cmd_b)[:-1], middle[:-1], atol=0.01)


def test_smoothing_does_not_flatten_what_is_curved():
    t = np.arange(0.0, 2.0, 0.001)
    wave = np.sin(2 * np.pi * 8.0 * t)[:, None]
    at = np.arange(0.1, 1.9, 0.01)
    exact = np.sin(2 * np.pi * 8.0 * at)[:, None]
    assert np.abs(smoothed(t, wave, at, 0.01) - exact).max() < 5e-4
    assert np.abs(averaged(t, wave, at, 0.01) - exact).max() > 5e-3
    noise = np.random.default_rng(0).normal(size=wave.shape)
    assert np.std(smoothed(t, noise, at, 0.01)) < 0.55


def test_a_command_that_stops_is_not_held_for_long(tmp_path):
    good = flight()
    before = good["time"] < 5.0
    path = write(tmp_path / "log.csv", good, {"cmd_rate": before, "cmd_thrust": before})
    log, _ = import_log(path)
    missing = np.isnan(np.asarray(log.thrust_cmd))
    assert missing[log.time_s > 5.6].all() and not missing[log.time_s < 5.4].any()


def test_samples_that_are_ages_apart_are_no_rows():
    """Of a damaged clock: rows between them would fill any memory."""
    time = 1e7 * np.arange(200.0)
    pose, _ = make_signal(time, np.zeros((200, 3)), "log", "position")
    assert pose is not None
    with pytest.raises(FlightLogError, match=r"1e\+07 s apart.* at most 4,000,000: is its clock"):
        row_times(Recording("log", {"pos": pose}), 100.0, 0.0, None)


def test_two_flights_in_one_file_are_refused(tmp_path):
    good = flight(end=3.0)
    twice = {name: np.concatenate([value, value]) for name, value in good.items()}
    with pytest.raises(FlightLogError, match="cut the file to one flight"):
        import_log(write(tmp_path / "log.csv", twice))


def test_unknown_samples_and_steps_of_time_that_are_none_are_left_out():
    time = np.arange(40.0)
    time[7] = 5.5  # goes back once
    value = np.arange(40.0)
    value[20], time[30] = np.nan, np.nan
    found, finding = make_signal(time, value, "log", "gyro")
    assert found is not None and finding is not None
    kept = np.delete(np.arange(40), [7, 20, 30])
    np.testing.assert_array_equal(found.time_s, kept)
    np.testing.assert_array_equal(found.value, kept[:, None])
    assert finding.evidence == "1 samples of 'gyro' whose time does not increase are left out"
    time = np.array([0.0, 1e-310, *range(1, 60)])  # nothing can be divided by the first step
    found, finding = make_signal(time, time, "log", "gyro")
    assert found is not None and len(found.time_s) == len(time) - 1 and finding is not None


def test_a_time_that_goes_back_often_is_refused_and_few_known_samples_are_no_signal():
    with pytest.raises(FlightLogError, match=r"row 2: .* 9 of 10 samples of 'gyro'"):
        make_signal(np.arange(10.0)[::-1], np.zeros((10, 3)), "log", "gyro")
    with pytest.raises(FlightLogError, match="row 4: "):
        make_signal(np.arange(10.0)[::-1], np.array([np.nan] * 2 + [0.0] * 8), "log", "gyro")
    assert make_signal(np.full(3, np.nan), np.zeros(3), "log", "gyro") == (None, None)
    assert median_step(np.array([0.0, 0.5, 1.0, 9.0])) == 0.5 and median_step(np.zeros(1)) == np.inf


@pytest.fixture
def signals():
    truth = known_flight.fly(np.arange(0, 6, 0.01))
    rng = np.random.default_rng(3)
    quat = truth.quat + 2e-4 * rng.normal(size=truth.quat.shape)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return {
        "pos": Signal(truth.time, truth.pos + 2e-4 * rng.normal(size=truth.pos.shape)),
        "vel": Signal(truth.time, truth.vel + 0.01 * rng.normal(size=truth.vel.shape)),
        "quat": Signal(truth.time, quat),
    }


def test_a_good_flight_is_left_as_it_is(signals):
    cleaned = clean(Recording("log", signals))
    assert cleaned.findings == ()
    for name, samples in signals.items():
        np.testing.assert_array_equal(cleaned.signals[name].value, samples.value)


def test_a_jump_of_position_and_one_of_speed_are_left_out(signals):
    signals["pos"].value[200] += [0.0, 0.5, 0.0]
    signals["vel"].value[320] += [1.0, 0.0, 0.0]
    cleaned = clean(Recording("log", signals))
    assert 2.0 not in cleaned.signals["pos"].time_s
    assert len(cleaned.signals["pos"].time_s) == 599
    assert np.abs(cleaned.signals["vel"].time_s - 3.2).min() > 0.005
    assert {finding.signal for finding in cleaned.findings} == {"position", "velocity"}


def test_a_lone_position_does_not_end_the_check_of_velocities(signals):
    kept = np.delete(np.arange(600), [*range(400, 425), *range(426, 450)])
    signals["pos"] = Signal(*(part[kept] for part in signals["pos"]))
    signals["vel"].value[320] += [1.0, 0.0, 0.0]
    cleaned = clean(Recording("log", signals))
    assert 599 == len(cleaned.signals["vel"].time_s)


def test_repeated_poses_are_left_out_with_what_is_logged_with_them(signals):
    for samples in signals.values():
        samples.value[1::3] = samples.value[0::3]
    cleaned = without_repeats(Recording("log", signals))
    assert {len(cleaned.signals[name].time_s) for name in signals} == {400}
    assert "33 % of the poses repeat" in cleaned.findings[0].evidence


def test_whole_millimetres_are_not_repeats(signals):
    coarse = np.round(0.02 * signals["pos"].value, 3)
    cleaned = without_repeats(Recording("log", {"pos": Signal(signals["pos"].time_s, coarse)}))
    assert len(cleaned.signals["pos"].time_s) == 600
    assert not [finding for finding in cleaned.findings if "repeat" in finding.evidence]


def test_attitudes_drawn_between_their_neighbours_are_left_out(signals):
    quat = signals["quat"].value
    middle = quat[0:-2:2] + quat[2::2]
    quat[1:-1:2] = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    cleaned = clean(Recording("log", {"quat": signals["quat"]}))
    assert len(cleaned.signals["quat"].time_s) < 340
    assert "are interpolated" in cleaned.findings[0].evidence


TIME = np.arange(0, 10, 0.01)


def recording(lift=2.0, land=8.0, ground=0.3):
    height = np.interp(TIME, [0, lift, lift + 1, land - 1, land, 10], [0, 0, 1, 1, 0, 0]) + ground
    # The motors run up half a second before they lift, and stop a while after touching down.
    pwm = np.interp(TIME, [0, lift - 0.5, lift, land, land + 0.3], [0, 0, 0.6, 0.6, 0])
    pos = np.stack([0 * TIME, 0 * TIME, height], axis=1)
    return Recording(
        "log", {"pos": Signal(TIME, pos), "pwm": Signal(TIME, np.repeat(pwm[:, None], 4, 1))}
    )


def test_the_flight_is_found_between_take_off_and_landing():
    (start, stop), findings = airborne(recording())
    # It rises by 1 m in the second after lifting: 5 cm after 0.05 s.
    np.testing.assert_allclose([start, stop], [2.06, 7.94], atol=0.02)
    assert "2.1 s before take-off" in findings[0].evidence


def test_without_motors_or_without_a_take_off_nothing_is_cut():
    signals = recording().signals
    inside = (TIME > 3) & (TIME < 6)
    flying = {n: Signal(s.time_s[inside], s.value[inside]) for n, s in signals.items()}
    span, (finding,) = airborne(Recording("log", flying))
    assert span == (-np.inf, np.inf) and finding.status == "ok"
    span, (finding,) = airborne(Recording("log", {"pos": signals["pos"]}))
    assert span == (-np.inf, np.inf) and "no signal shows when the motors" in finding.evidence


def test_positions_that_miss_the_flight_move_neither_end_of_it():
    signals = recording().signals
    late = TIME < 1.2
    pos = Signal(TIME[late], signals["pos"].value[late])
    span, _ = airborne(Recording("log", {"pos": pos, "pwm": signals["pwm"]}))
    np.testing.assert_allclose(span, (1.75, 8.15), atol=0.02)


def test_speeds_with_the_sign_of_their_spin_show_the_flight():
    speed = np.where((TIME > 2.0) & (TIME < 8.0), 700.0, 50.0)[:, None] * [1.0, -1.0, 1.0, -1.0]
    span, _ = airborne(Recording("log", {"motor": Signal(TIME, speed)}))
    np.testing.assert_allclose(span, (2.0, 8.0), atol=0.02)


def _gyro(span, rate=500.0, bias=0.0, noise=0.0):
    truth = known_flight.fly(np.arange(span[0], span[1], 1 / rate))
    rng = np.random.default_rng(2)
    return Signal(truth.time, truth.rate + bias + noise * rng.normal(size=truth.rate.shape))


def _poses(span, rate, offset, drift, noise=0.0, turn=None):
    time = np.arange(span[0], span[1], 1 / rate)
    rot = Rotation.from_matrix(known_flight.fly(time).rot)
    rot = rot if turn is None else rot * turn
    rng = np.random.default_rng(3)
    rot = rot * Rotation.from_rotvec(noise * rng.normal(size=(len(time), 3)))
    return Signal((time - offset) / (1 + drift), rot.as_quat(scalar_first=True))


@pytest.mark.parametrize(
    ("offset", "drift", "rate"),
    [more(0.0, 0.0, 240.0), more(-7.77, -400e-6, 120.0), (1.7e6, 30e-6, 60.0)],
)
def test_offset_and_drift_come_back(offset, drift, rate):
    found = align(_poses((5, 45), rate, offset, drift), _gyro((0, 60), bias=0.02), "pose")
    at = (np.array([5.0, 25.0, 45.0]) - offset) / (1 + drift)
    log_time = found.offset_s + (1 + found.drift) * at
    np.testing.assert_allclose(log_time, [5.0, 25.0, 45.0], atol=2e-4)
    assert found.correlation > 0.999


def test_noise_widens_the_reported_error():
    calm = align(_poses((1, 19), 120.0, 2.0, 0.0), _gyro((0, 20)), "pose")
    poses = _poses((1, 19), 120.0, 2.0, 0.0, noise=0.002)
    shaken = align(poses, _gyro((0, 20), noise=0.1), "pose")
    middle = 10.0 - 2.0
    error = abs(shaken.offset_s + (1 + shaken.drift) * middle - 10.0)
    assert calm.offset_sd_s < shaken.offset_sd_s < 5e-3
    assert error < 4 * shaken.offset_sd_s


def test_short_poses_late_in_a_long_log_are_aligned():
    found = align(_poses((50, 58), 120.0, 2.0, 0.0), _gyro((0, 60)), "pose")
    assert found.offset_s == pytest.approx(2.0, abs=1e-3) and found.correlation > 0.99


def test_clocks_that_agree_best_where_the_signals_do_not_overlap_are_not_aligned(monkeypatch):
    monkeypatch.setattr("eval.importers.pose._coarse_offset", lambda *_: -4260.0)
    found = align(_poses((1, 19), 120.0, 2.0, 0.0), _gyro((0, 20)), "pose")
    assert found.correlation == 0.0 and found.drift == 0.0


def test_a_turn_between_the_bodies_is_found():
    turn = Rotation.from_rotvec([0.4, -0.8, 1.9])
    found = align(_poses((1, 19), 120.0, 2.0, 0.0, turn=turn), _gyro((0, 20)), "pose")
    np.testing.assert_allclose(found.rotation, turn.as_matrix(), atol=1e-3)


def _import(tmp_path, text=None, source=known_flight.fly):
    log = made.write_blackbox(tmp_path / "log.csv", span=(0, 12), rate=250.0, source=source)
    pose = tmp_path / "pose.csv"
    if text is not None:
        pose.write_text(text)
    return import_log(log, None, ImportOptions(pose=pose, full_thrust=30.0))


def test_faults_of_the_poses_are_corrected(tmp_path):
    made.write_mocap(tmp_path / "pose.csv", span=(1.0003, 11), offset=4.0)
    lines = (tmp_path / "pose.csv").read_text().splitlines()
    # Time in us, the quaternion xyzw under the names of wxyz.
    rows = [lines[0]]
    for line in lines[1:]:
        t, x, y, z, qw, qx, qy, qz = line.split(",")
        rows.append(",".join([f"{float(t) * 1e6:.1f}", x, y, z, qx, qy, qz, qw]))
    log, findings = _import(tmp_path, "\n".join(rows))
    assert {"pose time", "pose attitude"} == {f.signal for f in findings if f.status == "corrected"}
    truth = known_flight.fly(log.time_s + 1.0003)
    np.testing.assert_allclose(log.pos_w, truth.pos, atol=2e-3)
    np.testing.assert_allclose(np.abs(np.sum(log.quat_wxyz * truth.quat, 1)), 1.0, atol=1e-5)


def test_attitudes_of_zeros_are_dropouts_and_a_velocity_in_the_logs_world_is_dropped(tmp_path):
    path = made.write_mocap(tmp_path / "pose.csv", span=(1, 7), offset=4.0)
    lines = path.read_text().splitlines()
    lines[200:210] = [",".join([*line.split(",")[:4], "0,0,0,0"]) for line in lines[200:210]]
    path.write_text("\n".join(lines))
    usd = made.write_usd(tmp_path / "log00")
    log, findings = import_log(usd, None, ImportOptions(pose=path, full_thrust=30.0))
    assert "ppm off; rates correlate by" in text(findings, "pose clock")
    found = text(findings, "attitude") + text(findings, "pose")
    assert "10 samples of 'quat' are zeros" in found and "vel of the log are in another" in found
    truth = known_flight.fly(log.time_s + 1.0)
    assert log.velocity_derived and np.isfinite(log.quat_wxyz).mean() > 0.95
    off = 1.0 - np.abs(np.sum(log.quat_wxyz * truth.quat, 1))
    assert np.nanmax(off) < 1e-4


def test_slow_poses_are_no_fast_ones_in_a_smaller_unit_and_the_long_file_is_named(tmp_path):
    poses = _poses((0, 60), 2.0, 0.0, 0.0)
    assert _in_seconds(Recording("pose", {"quat": poses})).findings == ()
    fast = Signal(np.arange(0, 8e6, 5e3), known_flight.fly(np.arange(0, 8, 0.005)).rate)
    with pytest.raises(FlightLogError, match=r"^log: column time: lasts 7.995e\+06 s, more"):
        path = made.write_mocap(tmp_path / "pose.csv", span=(0, 8))
        with_pose(Recording("log", {"rate": fast}), ImportOptions(pose=path))


@pytest.mark.extended
def test_a_turned_marker_body_is_corrected(tmp_path):
    turn = Rotation.from_euler("z", 90, degrees=True)
    made.write_mocap(tmp_path / "pose.csv", span=(1, 11), turn=turn)
    log, findings = _import(tmp_path)
    truth = known_flight.fly(log.time_s + 1.0)
    assert "pose axes" in {f.signal for f in findings if f.status == "corrected"}
    np.testing.assert_allclose(np.abs(np.sum(log.quat_wxyz * truth.quat, 1)), 1.0, atol=1e-5)


def pitch_reversed(time):
    truth = known_flight.fly(time)
    wrong = Rotation.from_quat(read_as("quat", truth.quat, "-pitch"), scalar_first=True)
    return truth._replace(rot=wrong.as_matrix())


def gyro_mirrored(time):
    truth = known_flight.fly(time)
    return truth._replace(rate=truth.rate * [1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ("poses", "log", "fault"),
    [
        more(pitch_reversed, known_flight.fly, "attitude_sign"),
        (known_flight.fly, gyro_mirrored, "gyro_axes"),
    ],
)
def test_a_wrong_sign_is_no_turned_body(tmp_path, poses, log, fault):
    made.write_mocap(tmp_path / "pose.csv", span=(1.0003, 11), offset=4.0, source=poses)
    _, findings = _import(tmp_path, source=log)
    assert {f.fault for f in findings if f.status == "corrected"} == {fault}


def test_a_pose_clock_that_no_crystal_keeps_is_named(tmp_path):
    made.write_mocap(tmp_path / "pose.csv", span=(1, 11), offset=4.0, drift=1e-3)
    _, findings = _import(tmp_path)
    (drift,) = [f for f in findings if f.fault == "clock_drift"]
    assert drift.size == pytest.approx(1e-3, rel=0.05)


def test_poses_of_another_flight_without_an_attitude_or_too_short_are_refused(tmp_path):
    def source(time):
        rng, truth = np.random.default_rng(0), known_flight.fly(time)
        smooth = np.cumsum(np.cumsum(rng.normal(size=(len(time), 3)), 0), 0)
        return truth._replace(rot=Rotation.from_rotvec(3 * smooth / smooth.max()).as_matrix())

    made.write_mocap(tmp_path / "pose.csv", span=(0, 10), source=source)
    with pytest.raises(FlightLogError, match=r"pose\.csv.*cannot be aligned"):
        _import(tmp_path)
    with pytest.raises(FlightLogError, match="holds no attitude; name its columns"):
        _import(tmp_path, "time,pos_x,pos_y,pos_z\n0,1,2,3\n1,2,3,4\n")
    made.write_mocap(tmp_path / "pose.csv", span=(1, 2))
    with pytest.raises(FlightLogError, match="less than 3 s"):
        _import(tmp_path)
