"""Both ends of a link in one process, on a clock that the test holds."""

import numpy as np
import pytest

from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import TrialSpec, track_of
from suite.judging.link.companion import Companion
from suite.judging.link.messages import State, Wire, image_packets
from tests.support.courses import ONE_GATE
from tests.support.pilots import Pursuit

TRIAL = TrialSpec("zigzag", 0, 0)


class Bench:
    """A companion with the vehicle's wire in the test's hands."""

    def __init__(self, policy=None, limits=None):
        self.now = 100.0
        self.wire = Wire(1, 2)
        self.track = track_of({}, TRIAL)
        self.policy = policy or Pursuit()
        vehicle = load_vehicle("reference")
        wire = Wire(2, 1)
        self.companion = Companion(self.policy, self.track, vehicle, wire, lambda: self.now, limits)
        camera = self.policy.spec.camera
        self.image = np.full((camera.height, camera.width), camera.range_m)

    def state(self, **changed):
        level = np.array([1.0, 0.0, 0.0, 0.0])
        place = np.array(self.track.start_pos_w, float)
        return State(self.now, place, level, np.zeros(3), np.zeros(3))._replace(**changed)

    def show(self):
        """Send an image."""
        packets = image_packets(self.image, self.policy.spec.camera.range_m)
        return self.companion.receive([self.wire.encode(packet) for packet in packets])

    def tell(self, state=None):
        """Send a state; what the companion answers, decoded."""
        datagram = self.wire.encode(self.state() if state is None else state)
        return self.wire.decode(self.companion.receive([datagram]))

    def fly(self, steps=5):
        """Fly so many states of 10 ms, with an image before the first."""
        self.show()
        for _ in range(steps):
            self.tell()
            self.now += 0.01
        assert self.companion.flying
        return self


@pytest.fixture
def track(tmp_path):
    """Return a track file that is read faster than one with a mesh."""
    (file := tmp_path / "yard.toml").write_text(ONE_GATE)
    return file


@pytest.fixture
def real(track):
    """Return a command that flies a real vehicle, but for its folder."""
    return f"fly --link udpin:127.0.0.1:0 --track {track} --vehicle crazyflie21 --out"


@pytest.fixture
def bench():
    return Bench
