"""The companion: what it answers, when it hands over, and which signed messages it accepts."""

from pathlib import Path

import numpy as np
import pytest

from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import TrialSpec
from policies.spec import NoAnswer, PolicySpec
from suite.common.console import Console
from suite.judging.link.fly import _warn_of_rates
from suite.judging.link.log import write_log
from suite.judging.link.messages import OperatorText, SetPoint, State, Wire, dialect, signing_key
from suite.judging.link.watchdog import Limits, jump_fault
from tests.support.commands import refused
from tests.support.pilots import Steady

pytest.importorskip("pymavlink", reason="pymavlink is not installed (the extra mavlink)")


def test_a_state_is_answered_with_body_rates_and_thrust_but_never_on_an_old_image(bench):
    one = bench(Steady((0.0, 0.0, 0.0)))
    assert one.tell() == []  # nothing is flown blind
    one.show()
    (point,) = one.tell(one.state(time_s=one.now + 0.001))
    hover = 9.81 / load_vehicle("reference").full_thrust
    assert point.thrust == pytest.approx(hover, rel=1e-3)
    assert np.abs(point.rate_b[:2]).max() < 1e-6
    one = bench()
    one.show()
    one.now += 0.6
    assert one.tell() == [] and one.companion.over is None
    one.show()
    one.now += 0.01
    assert isinstance(one.tell()[0], SetPoint)


def test_silence_a_computer_that_stood_still_and_a_camera_that_stops_hand_over(bench):
    one = bench().fly()
    one.now += 0.085
    assert one.companion.receive([]) == []
    one.now += 0.01
    (note,) = one.wire.decode(one.companion.receive([]))
    assert "no state for 0.1 s" in note.text
    assert one.tell() == [] and not one.companion.flying
    one = bench().fly()
    one.now += 0.2
    assert isinstance(one.tell()[0], OperatorText)
    assert one.companion.over == "this computer stood still for 0.21 s"
    one = bench().fly(40)
    assert one.companion.flying
    for _ in range(20):
        one.tell()
        one.now += 0.01
    assert one.companion.over == "no image for 0.5 s"


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"pos_w": np.array([np.nan, 0.0, 1.0])}, "not finite"),
        ({"quat_wxyz": np.zeros(4)}, "not finite"),
        ({"vel_w": np.array([0.0, np.inf, 0.0])}, "not finite"),
        ({"quat_wxyz": np.array([np.cos(0.8), np.sin(0.8), 0.0, 0.0])}, "tilt 92 deg"),
        ({"pos_w": np.array([0.0, 500.0, 1.0])}, "outside the box"),
        ({"pos_w": np.array([0.0, 0.0, -3.0])}, "outside the box"),
        ({"time_s": 100.9}, "clock jumped by +0.8"),
        ({"time_s": 98.0}, "clock jumped by -2.0"),
        ({"pos_w": np.array([0.0, 3.0, 1.0])}, "position jumped by"),
        ({"resets": 1}, "estimator reset"),
    ],
)
def test_a_state_that_cannot_be_flown_on_hands_over(bench, changed, reason):
    one = bench().fly()
    with np.errstate(invalid="ignore"):
        (note,) = one.tell(one.state(**changed))
    assert isinstance(note, OperatorText) and "hands over" in note.text
    assert reason in one.companion.over and reason in one.companion.events[-1]


def odometry(quality=0, frames=(1, 12), vel=(2.0, 0.0, 0.0), component=1, time_s=100.0):
    """Return a datagram of a vehicle that has turned a quarter to the left, as PX4 counts it."""
    mav = dialect().MAVLink(None, srcSystem=1, srcComponent=component)
    left = [np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)]
    made = mav.odometry_encode(
        int(1e6 * time_s), *frames, 0.0, 0.0, -1.0, left, *vel, 0.0, 0.0, 0.0,
        [0.0] * 21, [0.0] * 21, 3, 0, quality,
    )  # fmt: skip
    return made.pack(mav)


def test_a_velocity_is_in_the_frame_of_its_message_and_other_frames_are_not_flown(bench):
    for frames, vel_w in (((1, 12), [0.0, 2.0, 0.0]), ((1, 1), [2.0, 0.0, 0.0])):
        (state,) = Wire(2, 1).decode([odometry(frames=frames)])
        assert isinstance(state, State) and state.fault == "" and state.resets == 3
        np.testing.assert_allclose(state.vel_w, vel_w, atol=1e-6)
    for changed, reason in (
        ({"frames": (20, 12)}, "in frames 20 and 12, allowed are 1"),
        ({"frames": (1, 8)}, "in frames 1 and 8, allowed are 1"),
        ({"quality": -1}, "estimator has failed"),
    ):
        one = bench()
        one.show()
        one.companion.receive([odometry(**changed)])
        assert reason in one.companion.over


def test_states_of_two_components_are_not_mixed(bench):
    one = bench()
    one.show()
    for component, time_s in ((1, 100.0), (1, 100.01), (197, 100.02)):
        assert one.companion.over is None
        one.companion.receive([odometry(component=component, time_s=time_s)])
    assert "ODOMETRY of the components 1 and 197" in one.companion.over


def test_of_a_backlog_the_newest_state_is_flown_and_gates_are_counted_in_all(bench):
    one = bench(Steady((0.0, 0.0, 0.0)))
    center_w, rot_w = (np.asarray(x[0]) for x in one.track.scene.gates[:2])
    through = 5.0 * rot_w[:, 0]
    place = center_w - 0.3 * rot_w[:, 0]
    one.show()
    one.tell(one.state(pos_w=place, vel_w=through))
    backlog = []
    for k in range(1, 10):
        one.now += 0.01
        state = one.state(pos_w=place + 0.01 * k * through, vel_w=through)
        backlog.append(one.wire.encode(state))
    newest = one.now
    # The newest came first: it was not the oldest that lay in the way.
    answers = one.wire.decode(one.companion.receive(backlog[::-1]))
    assert [type(x) for x in answers] == [SetPoint] and one.companion.flying
    assert one.companion.rows[-1].state.time_s == pytest.approx(newest, abs=2e-6)
    assert one.companion.gate == 1 and len(one.companion.rows) == 2


def test_a_delay_that_creeps_in_is_found(bench):
    one = bench().fly(1)
    begin = one.now
    while one.companion.flying and one.now < begin + 10.0:
        one.show()
        one.tell(one.state(time_s=begin + 0.9 * (one.now - begin)))
        one.now += 0.01
    assert "states are that late" in one.companion.over
    assert one.now - begin == pytest.approx(2.0, abs=0.15)


@pytest.mark.extended
def test_clocks_may_drift_apart(bench):
    one = bench().fly(1)
    for drift in (1.0 - 5e-4, 1.0 + 5e-4):
        begin, stamp = one.now, one.companion.rows[-1].state.time_s + 0.01
        while one.now < begin + 30.0:
            one.show()
            one.tell(one.state(time_s=stamp + drift * (one.now - begin)))
            one.now += 0.09
        assert one.companion.flying, one.companion.over


def no_answer():
    raise NoAnswer("no answer within 1 s")


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (no_answer, "the policy failed: NoAnswer: no answer within 1 s"),
        (lambda: np.full((1, 3), np.nan, np.float32), "the policy's answer is not finite"),
    ],
)
def test_a_policy_that_fails_hands_over_and_leaves_its_log(answer, reason, bench, tmp_path, capsys):
    class Failing(Steady):
        def act(self, hidden, state, image, fresh):
            hidden = hidden + 1
            return (answer() if hidden[0, 0] > 120 else np.zeros((1, 3), np.float32)), hidden

    one = bench(Failing(spec=PolicySpec(rate_hz=100.0)))
    for _ in range(3):
        one.fly(40)
    (note,) = one.tell()
    assert isinstance(note, OperatorText) and one.companion.over == reason and one.tell() == []
    about = TrialSpec("zigzag", 0, 0)._asdict()
    assert write_log(one.companion, about, tmp_path, Console())
    broken = one.companion.rows[1]
    state = broken.state._replace(quat_wxyz=np.zeros(4))
    one.companion.rows[1] = broken._replace(state=state)
    assert write_log(one.companion, about, tmp_path, Console()) is None
    assert "row 2: " in capsys.readouterr().err


def test_late_answers_are_not_flown_and_hand_over_where_they_go_on(bench):
    one = bench(limits=Limits(late_most=3))

    class Slow(Steady):
        def act(self, hidden, state, image, fresh):
            one.now += 0.05
            return super().act(hidden, state, image, fresh)

    one.companion._policy = Slow((5.0, 0.0, 0.0), spec=PolicySpec(rate_hz=100.0))
    one.show()
    for _ in range(2):
        assert isinstance(one.tell()[0], SetPoint)
        one.now += 0.01
    assert (one.companion.rows[-1].action_b == 0).all()
    assert isinstance(one.tell()[0], OperatorText)
    assert one.companion.over == "3 late answers in a row"
    assert one.companion.outputs.columns(0)["late_actions"] == 3


def test_answers_are_counted_as_in_the_judge(bench):
    one = bench(Steady((80.0, 0.0, 0.0), spec=PolicySpec(rate_hz=50.0))).fly()
    found = one.companion.outputs.columns(0)
    assert sum(row.decided for row in one.companion.rows) == found["decisions"] == 3
    assert (found["limited_actions"], found["output_max"]) == (3, 80.0)
    np.testing.assert_allclose(one.companion.rows[-1].action_b, [50.0, 0.0, 0.0])
    assert bench().fly().companion.outputs.columns(0)["limited_actions"] == 0


def test_the_heading_turns_as_fast_whatever_the_rate_of_states(bench):
    aside = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    wanted = []
    for rate_hz in (50, 100, 250):
        one = bench(Steady((0.0, 0.0, 0.0)))
        one.show()
        for k in range(rate_hz // 5 + 1):
            one.now = 100.0 + k / rate_hz
            one.tell(one.state(quat_wxyz=aside))
        wanted.append(one.companion.rows[-1].rate_b)
    assert abs(wanted[0][2]) > 0.5, "the gate is not ahead"
    assert wanted[0] == pytest.approx(wanted[1], rel=1e-6)
    assert wanted[2] == pytest.approx(wanted[1], rel=1e-6)


def test_what_a_gap_between_states_missed_is_counted_and_not_made_up_for(bench):
    one = bench(Steady((0.0, 0.0, 0.0), spec=PolicySpec(rate_hz=50.0)))
    one.show()
    for gap_s in (0.01, 0.01, 0.01, 0.07, 0.01, 0.01, 0.01):
        one.tell()
        one.now += gap_s
    # States at 0, 10, 20, 30, 100, 110, 120 ms; those of 40, 60 and 80 ms did not come.
    assert [row.decided for row in one.companion.rows] == [True, False] * 3 + [True]
    assert one.companion.missed_decisions == 3


def test_decisions_without_a_new_image_are_counted_and_reported(bench, capsys):
    one = bench(Steady((0.0, 0.0, 0.0), spec=PolicySpec(rate_hz=50.0)))
    for step in range(12):  # a decision at each second state, an image at each sixth
        if step % 6 == 0:
            one.show()
        one.tell()
        one.now += 0.01
    assert one.companion.repeated_images == 4
    results = {"missed_decisions": 0, "decisions": 6, "repeated_images": 4}
    _warn_of_rates(results, Console())
    assert "4 of 6 decisions had no new depth image" in " ".join(capsys.readouterr().err.split())
    _warn_of_rates(results | {"decisions": 40}, Console())
    assert capsys.readouterr().err == ""


def test_half_of_the_messages_cut_off_is_flown_on_and_all_of_them_is_silence(bench):
    one = bench().fly()
    for k in range(20):
        datagram = one.wire.encode(one.state())
        one.companion.receive([datagram[: len(datagram) - 9 * (k % 2)]])
        one.now += 0.01
    assert one.companion.flying and any("broken" in event for event in one.companion.events)
    for _ in range(12):
        one.companion.receive([one.wire.encode(one.state())[:-9]])
        one.now += 0.01
    assert one.companion.over == "no state for 0.1 s"


def test_another_system_and_an_old_state_are_not_listened_to(bench):
    one = bench().fly()
    far = one.state(pos_w=np.array([0.0, 900.0, 1.0]))
    assert one.companion.receive([Wire(9, 2).encode(far)]) == []
    assert one.companion.flying and "foreign" in one.companion.events[-1]
    assert one.tell(one.state(time_s=one.now - 0.04)) == [] and one.companion.flying


@pytest.mark.parametrize("late", [0, 2])
def test_a_network_that_doubles_or_reorders_packets_changes_nothing(bench, late):
    def doubled(datagrams):
        """Each datagram comes twice, the second time after `late` others."""
        first, second = ([(k + by, data) for k, data in enumerate(datagrams)] for by in (0, late))
        return [data for _, data in sorted([*first, *second], key=lambda entry: entry[0])]

    def flown(change):
        one = bench()
        receive = one.companion.receive
        one.companion.receive = lambda datagrams: receive(change(datagrams))
        one.image[:] = np.random.default_rng(0).uniform(1.0, 9.0, one.image.shape)
        one.show()
        for _ in range(3):
            old, new = one.state(time_s=one.now - 0.01), one.state()
            one.companion.receive([one.wire.encode(new), one.wire.encode(old)])
            one.now += 0.02
        return [(row.state.time_s, *row.rate_b, row.thrust) for row in one.companion.rows]

    rows = flown(lambda datagrams: datagrams)
    assert len(rows) == 3 and flown(doubled) == rows
    assert flown(lambda datagrams: [*datagrams[:1], *datagrams[:0:-1]]) == rows


def test_a_state_that_is_sent_again_and_again_hands_over_as_silence_does(bench):
    """The clock check alone would take 0.2 s, or as long as its limit allows."""
    one = bench(limits=Limits(clock_jump_s=100.0)).fly()
    frozen, begin = one.state(), one.now
    while one.companion.flying and one.now < begin + 1.0:
        one.tell(frozen)
        one.now += 0.01
    assert one.companion.over == "no newer state for 0.1 s"
    assert one.now - begin == pytest.approx(0.12, abs=0.011)


def test_depth_images_of_another_size_are_said_once(bench):
    one = bench()
    one.image = np.full((48, 64), 5.0)
    for _ in range(3):
        one.show()
    assert one.tell() == []
    said = [event for event in one.companion.events if "depth images" in event]
    assert len(said) == 1 and "64 x 48 pixels left out: the policy's are 32 x 24" in said[0]
    assert one.companion.wrong_image_size in said[0]


def test_a_state_may_lie_half_a_metre_off_where_its_speed_leads():
    """0.1 s at 3 m/s, and so much more."""
    level, still = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
    vel_w = np.array([3.0, 0.0, 0.0])
    last = State(1.0, still, level, vel_w, still)
    for off_m, jumped in ((0.45, False), (0.55, True)):
        state = State(1.1, np.array([0.3 + off_m, 0.0, 0.0]), level, vel_w, still)
        assert (jump_fault(last, state, Limits()) is not None) == jumped


pytest.importorskip("pymavlink", reason="pymavlink is not installed (the extra mavlink)")

POINT = SetPoint(np.array([0.5, -0.25, 2.0]), 0.375)


@pytest.fixture
def key(tmp_path):
    (tmp_path / "phrase").write_text("correct horse\n")
    return signing_key(tmp_path / "phrase")


def test_what_is_signed_is_heard_once_and_what_is_not_or_by_another_is_left_out(key):
    vehicle, companion = Wire(1, 2, key), Wire(2, 1, key)
    sent = companion.encode(POINT)
    assert vehicle.is_from_peer(sent) and vehicle.is_from_peer(sent), "to look is not to take"
    assert len(vehicle.decode([sent])) == 1 and vehicle.broken == 0
    assert vehicle.decode([sent]) == [] and vehicle.broken == 1, "sent again by someone else"
    assert vehicle.decode([companion.encode(OperatorText("a"))]) == [OperatorText("a")]
    vehicle, companion = Wire(1, 2, key), Wire(2, 1, key)
    first = companion.encode(POINT)
    forged = bytearray(companion.encode(OperatorText("b")))
    forged[-8:-6] = b"\xff\xff"  # of a later time, so that no true one would be later
    for odd in (Wire(2, 1).encode(POINT), Wire(2, 1, bytes(32)).encode(POINT), bytes(forged)):
        assert vehicle.decode([odd]) == [] and not vehicle.is_from_peer(odd)
    assert vehicle.broken == 3 and len(vehicle.decode([first])) == 1
    sent = Wire(2, 1).encode(POINT)
    assert sent[2] == 0, "no flag of a signature"
    assert len(Wire(1, 2).decode([sent])) == 1 == len(Wire(1, 2).decode([sent]))


def test_a_key_is_of_a_file_with_a_phrase_and_of_a_real_link(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert signing_key(None) is None
    (tmp_path / "empty").touch()
    with pytest.raises(ValueError, match="write the passphrase"):
        signing_key(tmp_path / "empty")
    with pytest.raises(ValueError, match="cannot be read"):
        signing_key(Path("nowhere"))
    assert "--signing-key needs --link" in refused(capsys, "fly --signing-key empty")
    assert "--confirm needs --link" in refused(capsys, "fly --confirm")
