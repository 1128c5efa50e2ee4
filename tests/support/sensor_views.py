"""Observations for tests of sensor models, draws of random numbers, and what a model shows."""

import numpy as np

from eval import sensors
from eval.sensors import SENSORS, view_models
from eval.sensors.interface import blank_draws
from eval.sensors.sensors_file import sensor_set
from policies.observation import View
from tracks.geometry.camera import Camera

CAMERA = Camera(pitch_deg=0.0, fov_deg=(90.0, 90.0), width=8, height=6)
DT_S = 0.1
LEVEL, ALONG = np.eye(3)[None], np.array([[1.0, 0.0, 0.0]])


def view(pos=(0.0, 0.0, 0.0), rot=LEVEL, gate=(4.0, 0.0, 0.0), depth=4.0, number=0):
    depth_m = np.broadcast_to(depth, (1, 6, 8)).astype(float)
    places = (np.array([place], float) for place in (gate, (8.0, 2.0, 0.0)))
    vel_w = np.array([[2.0, 0.0, 0.0]])
    return View(
        np.array([pos], float), rot, vel_w, *places, ALONG, ALONG, depth_m, np.array([number])
    )


def draws_of(needs, **numbers):
    """Return draws of zeros (of chances: ones, by which nothing happens) but for `numbers`."""
    blank = blank_draws(needs, 1, CAMERA)
    blank.uniform[:], blank.chance[:] = 1.0, 1.0
    for name, value in numbers.items():
        getattr(blank, name)[:] = value
    return blank


def seen_through(name, values, views, trial=None, **numbers):
    """Return what a model shows of views one after the other, with the same draws for each."""
    models, sensor = view_models(sensor_set({name: values}).models), SENSORS[name]
    first, each = draws_of(sensor.trial, **(trial or {})), draws_of(sensor.observation, **numbers)
    memory = sensors.start(models, views[0], {name: first}, DT_S, CAMERA)
    shown = []
    for one in views:
        seen, memory = sensors.sense(models, memory, one, {name: each}, DT_S, CAMERA)
        shown.append(seen)
    return shown
