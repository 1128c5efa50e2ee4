"""Fly the shipped policy race once in MuJoCo, and draw the flight.

Run: python examples/fly_and_plot.py [FOLDER]; it writes trial.png, trial.gif and trial.rrd.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from eval.judging.judge import JudgeOptions, Record, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.view.picture import write_picture
from eval.view.recording import write_recording
from eval.view.video import VideoOptions, write_video
from eval.worlds.trial import TrialSpec
from policies.policy import load_policy
from tracks.families import make_track


def main(folder: Path) -> None:
    """Fly one trial and write a picture, a GIF and a recording of it to `folder`."""
    trial = TrialSpec(track="zigzag", difficulty=0, seed=1)
    flights: list[Any] = []
    (result,) = fly(
        load_policy("race"),
        [trial],
        load_vehicle("reference"),  # the vehicle of the result tables; no training uses it
        options=JudgeOptions(workers=1),
        on_result=lambda result, flight: flights.append(flight),
        record=Record(depth=True),
    )
    flight = flights[0]
    speed = np.linalg.norm(flight.vel_w, axis=1)  # (T,) [m/s], a row every physics step
    print(f"{result.gates_passed} gates, {result.ending} after {result.time_s:.1f} s")
    print(f"speed: mean {speed.mean():.1f} m/s, largest {speed.max():.1f} m/s")

    track = make_track(trial.track, trial.difficulty, trial.seed)
    write_picture(folder / "trial.png", track, flight, result)
    write_video(folder / "trial.gif", track, flight, result, VideoOptions((240, 120), fps=4))
    write_recording(folder / "trial.rrd", [(track, flight, result)])
    print(f"written to {folder}; open the recording with: rerun {folder / 'trial.rrd'}")


if __name__ == "__main__":
    arguments = sys.argv[1:]
    main(Path(arguments[0]) if arguments else Path(tempfile.mkdtemp()))
