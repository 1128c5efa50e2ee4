"""All that a diagnosis knows when it is done, before it is written down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.windows import FlightWindows, cut
from suite.diagnose.evidence.rollout_model import RolloutModel
from suite.diagnose.search.look import SearchResult, rollouts_of
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.confirmation import EffectSize, Negligible
from suite.diagnose.verdict.disturbances import Turbulence
from suite.diagnose.verdict.gap import Gap, Verdict
from suite.diagnose.verdict.residual_structure import ResidualStructure


@dataclass(frozen=True)
class Diagnosis:
    """What was found, and what it was found from."""

    verdict: Verdict
    search: SearchResult
    half_widths: np.ndarray
    """Of the 95 % intervals, in the order of `search.indices`."""
    vehicle: Vehicle
    """With the named effects in place of what the nominal one has of them."""
    before: Gap
    after: Gap
    without: dict[str, Gap]
    """By a named effect's label: the gap with all others."""
    control: tuple[str, Gap] | None
    """A wrong effect fitted in the same way, and its gap."""
    residual: ResidualStructure
    """Structure in what the named effects leave."""
    turbulence: Turbulence | None
    logs: Sequence[FlightLog]
    nominal: Vehicle
    """The vehicle that the simulation used."""
    rotor_input: bool
    """Whether measured rotor speeds were the model's input, not the commands."""
    sizes: dict[str, EffectSize]
    """What each named effect does on these flights, by its name."""
    negligible: list[Negligible]
    """What is significant and too small to matter."""
    held_out: list[str]
    """Names of what took no part in finding or fitting anything."""
    held_windows: FlightWindows
    """Overlapping windows over it."""
    model: RolloutModel
    """Of the nominal vehicle."""
    seconds: float
    warnings: list[str]
    seed: int
    """Of all draws."""
    limits: Thresholds = THRESHOLDS

    @property
    def sigma(self) -> np.ndarray:
        """(19,) measurement noise of each channel in its unit; NaN where nothing was measured."""
        return rollouts_of(self.search.last).noise.sigma

    @property
    def input_source(self) -> str:
        """What the model's input was, for people."""
        return "measured rotor speeds" if self.rotor_input else "commands"

    @property
    def start(self) -> np.ndarray:
        """Return the numbers (P,) of the vehicle file."""
        return self.model.space.array("start")

    @property
    def fitted(self) -> np.ndarray | None:
        """Return the numbers (P,) with what was named; None where nothing was."""
        return self.search.estimate.theta if self.search.named else None

    def cut(self, stride_s: float) -> FlightWindows:
        """Return windows of all flights, one every `stride_s` [s]."""
        how = (self.rotor_input, stride_s, self.limits, self.model.integrator)
        windows, _ = cut(self.logs, self.nominal, *how)
        assert windows is not None  # the diagnosis has cut them before
        return windows
