"""Doubts about the numbers of a vehicle file that no flight is needed for."""

from dataclasses import replace

import pytest

from eval.logs.faults.vehicle import check_camera, vehicle_doubts
from tests.support.vehicles import PLAIN
from tracks.geometry.camera import Camera


@pytest.mark.parametrize(
    ("gain", "lag_s", "doubted"),
    [(60.0, 0.05, False), (300.0, 0.0, False), (600.0, 0.0, True), (300.0, 0.03, True)],
)
def test_a_rate_gain_too_fast_for_the_loop_or_the_rotors_is_doubted(gain, lag_s, doubted):
    rotors = replace(PLAIN.rotors, time_constant=lag_s)
    controller = replace(PLAIN.controller, rate_gain=(20.0, gain, 8.0), frequency=500.0)
    doubts = vehicle_doubts(replace(PLAIN, rotors=rotors, controller=controller))
    assert len(doubts) == doubted
    assert all(f"rate_gain has {gain:g} 1/s; usual are 5 to 40" in doubt for doubt in doubts)


def test_the_pitch_of_the_camera_is_compared_as_its_field_of_view():
    for camera, fault in ((Camera(), ""), (Camera(pitch_deg=18.0), "camera_fov")):
        (finding,) = check_camera(camera, PLAIN)
        assert finding.fault == fault, camera
