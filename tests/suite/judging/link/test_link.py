"""The link: what travels, when the companion hands over, and a flight with both ends."""

import json
import multiprocessing
import shutil
from dataclasses import replace

import numpy as np
import pytest

from eval.judging.monitor import Monitored
from eval.logs.flight_log import read_flight
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules, TrialSpec, track_of
from policies.block_policy import BlockPolicy
from policies.policy import load_policy
from policies.spec import ActionSpec, DepthEncoding, Note, PolicySpec
from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.judging.link import fly, server
from suite.judging.link.companion import Companion, Row
from suite.judging.link.flights import Flight, delays, fly_link, totals, warm_up
from suite.judging.link.log import write_log
from suite.judging.link.messages import (
    ImageAssembler,
    OperatorText,
    Packet,
    SetPoint,
    State,
    Wire,
    flip_axes,
    flip_quat,
    image_packets,
)
from suite.judging.link.simulated import LOST_S, FlightRequest, SimulatedVehicle
from suite.judging.link.udp import UdpLink
from suite.judging.link.watchdog import Limits
from suite.judging.trials import NO_LEVELS
from tests.support.commands import answer, refused, run
from tests.support.pilots import Pursuit
from tracks.geometry.rotation import quat_to_rot

pytest.importorskip("pymavlink", reason="pymavlink is not installed (the extra mavlink)")


def turned(rng):
    """Return an attitude as a random quaternion."""
    quat = rng.normal(size=4)
    return quat / np.linalg.norm(quat)


def test_frames_are_one_half_turn_about_x():
    rng = np.random.default_rng(0)
    quat, vector = turned(rng), rng.normal(size=3)
    assert (flip_axes(flip_axes(vector)) == vector).all()
    there = quat_to_rot(flip_quat(quat)) @ flip_axes(vector)
    np.testing.assert_allclose(there, flip_axes(quat_to_rot(quat) @ vector), atol=1e-12)
    # A climb is a negative "down"; a left turn a negative yaw rate.
    assert flip_axes([0, 0, 1.0])[2] == -1.0


def test_states_set_points_and_words_come_as_they_went():
    rng = np.random.default_rng(1)
    place, vel, rate = rng.normal(size=(3, 3))
    state = State(12.345678, place, turned(rng), vel, rate)
    vehicle, companion = Wire(1, 2), Wire(2, 1)
    (found,) = companion.decode([vehicle.encode(state)])
    assert isinstance(found, State)
    assert found.time_s == pytest.approx(state.time_s, abs=2e-6)
    assert found[5:] == state[5:] == (0, "", 1)
    for one, other in zip(found[:5], state[:5], strict=True):
        np.testing.assert_allclose(one, other, atol=2e-6)
    wanted = SetPoint(np.array([0.5, -0.25, 2.0]), 0.375)
    (point,) = vehicle.decode([companion.encode(wanted)])
    assert isinstance(point, SetPoint)
    assert (point.rate_b == wanted.rate_b).all() and point.thrust == wanted.thrust
    assert vehicle.decode([companion.encode(OperatorText("words"))]) == [OperatorText("words")]


def test_an_image_comes_whole_or_not_at_all_also_where_16_bits_do_not_count_its_bytes():
    rng = np.random.default_rng(2)
    depth = rng.uniform(0.1, 12.0, (24, 32))
    vehicle, companion = Wire(1, 2), Wire(2, 1)
    sent = [vehicle.encode(packet) for packet in image_packets(depth, 10.0)]
    assert len(sent) == 8

    def seen(datagrams, height=24):
        picture, packets = ImageAssembler(height, 32, 10.0), companion.decode(datagrams)
        found = [picture.add(packet) for packet in packets if isinstance(packet, Packet)]
        return [image for image in found if image is not None]

    (image,) = seen(sent)
    np.testing.assert_allclose(image, np.minimum(depth, 10.0), atol=5.1e-4)
    assert seen(sent[:3] + sent[4:]) == []
    assert len(seen(sent[:3] + sent)) == 1
    assert seen(sent, height=20) == []
    assert seen([companion.encode(Packet(3, 0, b"x"))]) == []
    # The end of one and the announcement of the next are lost: no image is made of two.
    later = [vehicle.encode(packet) for packet in image_packets(depth + 1.0, 20.0)]
    assert seen(sent[:6] + sent[7:] + later[1:]) == []
    assert len(seen(sent[:6] + later)) == 1
    depth = np.linspace(0.1, 9.9, 256 * 256).reshape(256, 256)
    wire, picture = Wire(1, 1), ImageAssembler(256, 256, 10.0)
    packets = wire.decode(wire.encode(packet) for packet in image_packets(depth, 10.0))
    found = [picture.add(packet) for packet in packets if isinstance(packet, Packet)]
    np.testing.assert_allclose(found[-1], depth, atol=5.1e-4)
    with pytest.raises(ValueError, match="a camera of 4000 x 4000 pixels"):
        ImageAssembler(4000, 4000, 10.0)


def test_what_is_cut_off_or_of_another_system_is_left_out_and_counted(bench):
    sender, stranger, companion = Wire(1, 2), Wire(9, 2), Wire(2, 1)
    whole = sender.encode(bench().state())
    for length in (1, 5, len(whole) // 2, len(whole) - 1):
        found = companion.decode([whole[:length], whole])
        assert len(found) == 1 and isinstance(found[0], State)
    assert companion.broken == 4
    assert companion.decode([b"\xfd\xff" * 40, b"", b"\x00"]) == []
    assert companion.decode([stranger.encode(bench().state())]) == []
    assert companion.foreign == 1
    # A set point for another vehicle is none for this one.
    assert sender.decode([Wire(2, 7).encode(SetPoint(np.zeros(3), 0.5))]) == []


@pytest.fixture(scope="module")
def flown():
    """A flight of two seconds in lockstep: vehicle, companion."""
    trial = TrialSpec("zigzag", 0, 0)
    track, vehicle, pilot = track_of({}, trial), load_vehicle("reference"), Pursuit()
    rules, camera = Rules(time_limit_s=4.0), pilot.spec.camera
    request = FlightRequest(track, trial, vehicle, rules, camera, 30.0, "pursuit")
    sim = SimulatedVehicle(request, Wire(1, 2))
    companion = Companion(pilot, track, vehicle, Wire(2, 1), lambda: sim.time_s)
    out = []
    while sim.time_s < 2.2:
        out = companion.receive(sim.step(out))
    return sim, companion


def test_both_ends_agree_on_the_flight(flown, tmp_path):
    sim, companion = flown
    assert companion.flying and companion.gate >= 1
    assert sim.result().gates_passed == companion.gate
    rows = companion.rows
    assert np.mean([row.decided for row in rows]) == pytest.approx(0.3, abs=0.02)
    found = delays(rows, 0.02)
    assert found["deadlines_missed"] == 0 and found["state_age_ms"]["max"] < 3.0
    # The camera keeps time with the decisions: no image waits for a whole period.
    assert found["image_age_ms"]["max"] <= 10.0 + 1e-6
    log = read_flight(tmp_path / write_log(companion, sim.result()._asdict(), tmp_path, Console()))
    assert log.about["handed_over"] is None and log.about["events"]
    assert np.isfinite(log.pos_w[:, 0]).sum() == len(rows) and log.action_b is not None
    assert log.gate is not None and log.gate.max() == companion.gate
    row = {**sim.result()._asdict(), "handed_over": None}
    row |= dict.fromkeys(("vehicle_slips", "missed_decisions", "repeated_images"), 0)
    assert totals([Flight(row, rows)], Limits())["set_points"] == len(rows)


def test_delays_are_those_of_the_rows():
    zero = np.zeros(3)
    state = State(0.0, zero, np.array([1.0, 0.0, 0.0, 0.0]), zero, zero)
    rows = [
        Row(state, 9.81, zero, zero, decided, 0, answered_s, answered_s, 0.004, image_age_s)
        for decided, answered_s, image_age_s in [(True, 0.03, 0.01), (False, 0.001, 0.5)]
    ]
    found = delays(rows, 0.02)
    assert found["set_points"] == 2 and found["decisions"] == found["deadlines_missed"] == 1
    assert found["answer_ms"]["max"] == found["decision_ms"]["max"] == pytest.approx(30.0)
    assert found["image_age_ms"]["max"] == pytest.approx(10.0)


def test_without_set_points_the_vehicle_brakes_by_itself(flown):
    sim, companion = flown
    companion.over = "the test"
    speed = []
    while not sim.over and len(speed) < 750:
        companion.receive(sim.step([]))
        speed.append(np.linalg.norm(sim._data.qvel[:3]))
    assert speed[0] > 2.0
    assert sim.over or speed[-1] < 0.4 * speed[int(LOST_S / sim.dt)]


@pytest.fixture
def links():
    """Make links that are closed after the test."""
    made = []

    def link(address, *rest):
        made.append(UdpLink(address, *rest))
        return made[-1]

    yield link
    for one in made:
        one.close()


def test_datagrams_are_taken_from_one_caller_that_speaks_for_the_vehicle(links, bench):
    waiting = links("udpin:127.0.0.1:0")
    first, second = (links(f"udpout:127.0.0.1:{waiting.port}") for _ in range(2))
    first.send([b"one"])
    assert waiting.receive(1.0) == [b"one"]
    second.send([b"two"])
    first.send([b"three"])
    assert waiting.receive(1.0) == [b"three"] and waiting.strangers == 1
    waiting.send([b"back"])
    assert first.receive(1.0) == [b"back"]
    # Nobody listens: words are lost and nothing is raised.
    waiting.close()
    first.send([b"gone"])
    assert first.receive(0.01) == []
    assert waiting.receive() == [], "an error of the socket that stays does not block"
    waiting = links("udpin:127.0.0.1:0", bench().companion._wire.is_from_peer)
    stranger, other, vehicle = (links(f"udpout:127.0.0.1:{waiting.port}") for _ in range(3))
    stranger.send([b"anybody there?"])
    other.send([Wire(9, 2).encode(bench().state())])
    assert waiting.receive(1.0) == [] and waiting.receive(0.2) == []
    said = Wire(1, 2).encode(bench().state())
    vehicle.send([said])
    assert waiting.receive(1.0) == [said] and waiting.strangers == 2


def test_addresses_that_cannot_be_are_refused(links):
    taken = links("udpin:127.0.0.1:0")
    wrong = ["tcp:1.2.3.4:5", "udpin:14550", "udpin:127.0.0.1:99999", "udpin:203.0.113.1:14550"]
    for address in (*wrong, f"udpin:127.0.0.1:{taken.port}", "udpout:no host of this name:14550"):
        with pytest.raises(ValueError, match=f"--link {address}"):
            UdpLink(address)


def test_a_link_on_which_nobody_is_ends_and_a_vehicle_that_waits_is_called(
    bench, links, monkeypatch
):
    monkeypatch.setattr("suite.judging.link.flights.gc.collect", lambda: 0)  # of all tests' objects
    vehicle = links("udpin:127.0.0.1:0")
    for address in ("udpin:127.0.0.1:0", f"udpout:127.0.0.1:{vehicle.port}"):
        one, times = bench(), iter(np.arange(0.0, 100.0, 0.3))
        warm_up(one.policy)
        fly_link(one.companion, links(address), clock=lambda: next(times), wait_s=3.0)  # noqa: B023
        assert not one.companion.rows and one.companion.over is None
    heard = vehicle.receive(1.0)
    assert 2 <= len(heard) <= 4 and all(Wire(1, 2).is_from_peer(datagram) for datagram in heard)
    assert Wire(1, 2).decode(heard) == []


LINK = "fly --link udpin:127.0.0.1:0 --out"


def test_a_real_vehicle_needs_the_operators_word(capsys, tmp_path, monkeypatch, real, track):
    assert "docs/fly.md" in refused(capsys, real, tmp_path)
    assert "silence-s" in refused(capsys, real, tmp_path, "--silence-s", "-1")
    confirmed = (real, tmp_path, "--confirm")
    for one in ("--vehicle racer5", f"--track {track}"):
        said = refused(capsys, f"{LINK} {tmp_path} --confirm {one}")
        assert "the vehicle file (--vehicle) and the course (--track)" in said
    high = refused(capsys, "fly --floor-m 3 --out", tmp_path / "high")
    assert "--floor-m is 3, allowed is less than 1" in high and not (tmp_path / "high").exists()
    assert "--link flies one flight" in refused(capsys, *confirmed, "--trials", "3")
    assert "--time-limit-s ends simulated" in refused(capsys, *confirmed, "--time-limit-s", "5")

    def outside(companion, link):
        companion.over = "outside the box at 0.0, 0.0, -3.0 m"

    for fly_nowhere, words in (
        (lambda companion, link: None,
         "no vehicle sent a state (ODOMETRY) and a depth image within 30 s"),
        (lambda companion, link: setattr(link, "strangers", 5),
         "within 30 s (5 messages were ignored: damaged, not of MAVLink system 1, or not signed"),
        (outside, "before the first set point: outside the box at 0.0, 0.0, -3.0 m"),
    ):  # fmt: skip
        monkeypatch.setattr(fly, "fly_link", fly_nowhere)
        assert run(*confirmed) == 1
        assert words in (said := printed(capsys))
        assert "crazyflie21: full thrust per mass is 20.4" in said and "yard.toml" in said
        assert "messages are not signed" in said


def test_an_operator_who_ends_a_flight_is_told_to_the_vehicle_and_its_log_stays(
    capsys, tmp_path, monkeypatch, real
):
    sent = []

    def ended(companion, link):
        raise KeyboardInterrupt

    monkeypatch.setattr(fly, "fly_link", ended)
    monkeypatch.setattr(UdpLink, "send", lambda self, datagrams: sent.extend(datagrams))
    assert run(real, tmp_path, "--confirm") == 1
    assert "the operator" in printed(capsys) and len(sent) == 1 and b"the operator" in sent[0]
    (tmp_path / "zigzag-0-0.parquet").write_text("the log of a flight that ended by an error")
    for command in (f"{real} {tmp_path} --confirm", f"fly --out {tmp_path}"):
        assert "holds earlier flights" in refused(capsys, command)


def test_each_limit_has_an_option(capsys, tmp_path, monkeypatch):
    limits = Limits(
        silence_s=0.2, image_age_s=0.3, tilt_deg=40.0, margin_m=5.0, floor_m=-2.0,
        deadline_s=0.03, late_most=7, clock_jump_s=0.4, jump_m=0.6,
    )  # fmt: skip
    assert not set(vars(limits).items()) & set(vars(Limits()).items())
    words = [f"--{name.replace('_', '-')}={value}" for name, value in vars(limits).items()]
    monkeypatch.setattr(fly, "fly_over_link", lambda *given: {"limits": given[3]})
    assert answer(capsys, "fly --out", tmp_path, *words)["limits"] == vars(limits)


def printed(capsys):
    return " ".join("".join(capsys.readouterr()).split())


@pytest.mark.parametrize("call", ["start", "result", "stop"])
def test_a_vehicles_process_that_died_is_reported_whenever_it_is_used(call):
    vehicle = object.__new__(server.VehicleProcess)
    vehicle._pipe, remote = multiprocessing.Pipe()
    vehicle._pipe.send("unread")
    remote.close()
    with pytest.raises(WorkFailed, match="the simulated vehicle's process died"):
        getattr(vehicle, call)(*["a request"] * (call == "start"))


def test_flights_before_an_interrupt_are_kept_and_the_judges_refusal_comes_first(
    capsys, tmp_path, monkeypatch
):
    row = {"success": True, "handed_over": None, "seed": 0}
    counts = ("vehicle_slips", "late_actions", "missed_decisions", "repeated_images")
    row |= dict.fromkeys(counts, 0)
    stops = iter([WorkFailed("it died"), KeyboardInterrupt()])

    def interrupted(policy, course, *_):
        assert policy.block == 1
        yield Flight(row, [])
        raise next(stops)

    monkeypatch.setattr(fly, "fly_simulated", interrupted)
    asked = "fly --policy race --trials 2 --time-limit-s 0.2 --out"
    assert run(asked, tmp_path / "died") == 1
    assert json.loads((tmp_path / "died" / "fly.json").read_text())["trials"] == 1
    assert run(asked, tmp_path / "a") == 130
    answer = json.loads((tmp_path / "a" / "fly.json").read_text())
    assert (answer["trials"], answer["successes"], answer["judge_successes"]) == (1, 1, 0)
    config = json.loads((tmp_path / "a" / "run.json").read_text())["config"]
    assert config["policy"]["name"] == "race" and config["limits"]["silence_s"] == 0.1
    assert config["link"] == "simulated" and config["evaluation"]["time_limit_s"] == 0.2
    fast = Pursuit(spec=PolicySpec(rate_hz=2000.0))
    fast.notes = (Note("contract", "race: no contract in it", "write one"),)
    monkeypatch.setattr(fly, "load_in_manner", lambda *_: fast)
    said = refused(capsys, asked, tmp_path / "b")
    assert "spec.rate_hz is 2000" in said and "race: no contract in it; write one" in said
    fast = replace(load_policy("race"), spec=PolicySpec(action=ActionSpec("motors")))
    assert "race: commands motors" in refused(capsys, asked, tmp_path / "b")
    assert not (tmp_path / "b").exists()


def test_the_warm_up_has_the_image_of_the_policys_spec():
    policy = Pursuit(spec=PolicySpec(depth=DepthEncoding(channel_axis=True)))
    shapes = []
    policy.act = lambda hidden, state, image, fresh: shapes.append(image.shape) or (state, hidden)
    warm_up(policy)
    assert shapes == [(1, 1, 24, 32)] * 3


def test_two_tracks_of_one_name_are_refused(root, tmp_path, capsys):
    """Their logs would have one name."""
    yard = root / "tracks" / "examples" / "yard.toml"
    shutil.copytree(yard.parent, tmp_path / "other")
    both = f"{yard},{tmp_path / 'other' / 'yard.toml'}"
    said = refused(capsys, "fly --out", tmp_path / "out", "--track", both)
    assert "several tracks are called 'yard'" in said


@pytest.mark.slow
def test_a_flight_in_real_time_over_the_loopback(tmp_path, capsys):
    """Whether it finishes is the machine's affair: a busy one is handed over from."""
    assert server.WAIT_S > 1
    found = answer(capsys, "fly --trials 1 --out", tmp_path)
    (flight,) = found["flights"]
    assert found["set_points"] > found["decisions"] > 0 and found["judge_successes"] == 1
    assert found["successes"] == flight["success"]
    assert flight["success"] or flight["handed_over"] or flight["vehicle_slips"]
    log = read_flight(tmp_path / flight["file"])
    assert (log.integrator, log.step_s) == ("euler", 0.002), "the steps that a diagnosis repeats"


def test_a_speed_and_the_judges_monitor_fly_in_real_time_too(capsys, tmp_path, monkeypatch, real):
    flown = []
    said = refused(capsys, "fly --policy race-paper --speed 0.3 --out", tmp_path)
    assert "--speed 0.3: race-paper takes no speed" in said
    monkeypatch.setattr(fly, "_fly_real_vehicle", lambda policy, *_: flown.append(policy) or {})
    asked = (real.replace("fly", "fly --policy race --confirm", 1),)
    assert run(*asked, tmp_path / "a", "--speed", "0.3") == run(*asked, tmp_path / "b") == 0
    assert [policy.spec.speed for policy in flown] == [0.3, load_policy("race").spec.speed]
    capsys.readouterr()
    assert run(*asked, tmp_path / "c", "--monitor", "--difficulty", "9", "--json") == 0
    written, notes = capsys.readouterr()
    assert NO_LEVELS in notes
    found = json.loads(written)
    policy = flown[-1]
    assert isinstance(policy, Monitored) and isinstance(policy.policy, BlockPolicy)
    assert policy.policy.block == 1
    assert (found["policy"]["name"], found["interventions"]) == ("race+monitor", 0)
