"""A delay moves jumps past the rows of a log: several values are tried."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from suite.diagnose.estimate.block import Block, Estimate
from suite.diagnose.estimate.parameters import ParameterSpace, candidates, make_space
from suite.diagnose.evidence.evidence import Evidence
from suite.diagnose.search.search import search
from tests.support.vehicles import PLAIN

SPACE = make_space(PLAIN)
START = Estimate(SPACE.array("start"), np.zeros((0, 0)))
DELAY, GAIN = (
    next(i for i, e in enumerate(SPACE.entries) if e.effect == name)
    for name in ("command_delay", "rate_gain")
)
TIME_S = np.arange(0.0, 1.0, 5e-3)
WINDOWS = 12


@dataclass(frozen=True)
class Response(Evidence):
    """Response of 12 windows that follows commands at once, with a gain and a delay."""

    fine_s: np.ndarray
    command: np.ndarray
    measured: np.ndarray
    parameters: ParameterSpace = SPACE

    @property
    def space(self):
        return self.parameters

    def response(self, delay: float) -> np.ndarray:
        return np.array([np.interp(TIME_S - delay, self.fine_s, one) for one in self.command])

    def linearise(self, at: Estimate, indices: Sequence[int] | None = None) -> Block:
        along = tuple(range(len(SPACE.entries)) if indices is None else indices)
        delay, gain = at.theta[[DELAY, GAIN]]
        response = self.response(delay)
        slope = np.zeros((*response.shape, len(along)))
        rate = (self.response(delay + 1e-3) - self.response(delay - 1e-3)) / 2e-3
        for place, column in ((DELAY, gain * rate), (GAIN, response)):
            if place in along:
                slope[..., along.index(place)] = column
        windows = np.arange(WINDOWS)
        none = np.zeros((WINDOWS, 0))
        return Block(
            (self.measured - gain * response) / 0.1, slope / 0.1, along,
            windows % 4, 1.0 * (windows // 4), none, none[..., None] + np.zeros(len(along)),
        )  # fmt: skip

    def estimate_noise(self, at: Estimate) -> tuple[Evidence, Block]:
        return self, self.linearise(at)


def test_a_delay_longer_than_a_jump_is_named_and_not_a_lower_gain():
    rng, fine_s = np.random.default_rng(0), np.arange(-0.2, 1.2, 1e-3)
    command = gaussian_filter1d(rng.standard_normal((WINDOWS, len(fine_s))), 8.0)
    command /= command.std()
    flown = Response(fine_s, command, np.zeros((WINDOWS, len(TIME_S))))
    noise = 0.1 * rng.standard_normal(flown.measured.shape)
    flown = replace(flown, measured=flown.response(0.03) + noise)
    among = [c for c in candidates(SPACE, False, {"command"}) if {DELAY, GAIN} & {*c.indices}]

    found = search(flown, START, among)
    assert [one.label for one in found.candidates] == ["command_delay"]
    assert abs(found.estimate.theta[DELAY] - 0.03) < 1e-3
    # The tangent at no delay leads into another minimum.
    entries = tuple(replace(entry, tried=()) for entry in SPACE.entries)
    stuck = search(replace(flown, parameters=replace(SPACE, entries=entries)), START, among)
    assert "command_delay" not in [one.label for one in stuck.candidates]
