"""The catalogue of sensor models: errors of state estimates, gate positions, depth images and IMU.

A model turns a drone's true view (pose, velocity, next gates, depth image) into the view that its
policy gets. The trainer and the judge, which flies policies in simulation and scores them, apply
models with the functions here.

To add a model, write its `Sensor` and list it here. Another package adds one with an entry point of
the group `diffracing_suite.sensors`. A program adds one for its own process with
`SENSORS.register(sensor.name, sensor)`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from eval.effects.interface import as_arrays
from eval.sensors import (
    depth_cameras,
    gate_detection,
    gate_filter,
    gate_map,
    image_motion,
    imu,
    intermittent,
    measured_state,
    state_errors,
)
from eval.sensors.interface import Draws, Moment, Sensor, View
from tracks.common.names import Registry
from tracks.geometry.camera import Camera


def _registration_error(name: str, sensor: Any) -> str | None:
    """Return why `sensor` cannot be registered as `name`, or None."""
    if not isinstance(sensor, Sensor):
        return f"a {type(sensor).__name__}; must be an eval.sensors.interface.Sensor"
    if sensor.name != name:
        return f"its Sensor is called {sensor.name!r}; both names must be the same"
    fields, names = getattr(sensor.values, "_fields", ()), tuple(p.name for p in sensor.parameters)
    if fields != names or not set(sensor.grows) <= set(names):
        return (
            f"its values ({sensor.values.__name__}) have the fields {list(fields)} and its "
            f"parameters the names {list(names)}; both must be the same, and `grows` of them"
        )
    # Imported here, because only models of other programs need it.
    from eval.sensors.sense_check import sensor_problem

    return sensor_problem(sensor)


_BUILT_IN = (
    state_errors.DELAY,
    gate_map.SENSOR,
    state_errors.STATE_DRIFT,
    state_errors.STATE_NOISE,
    state_errors.DRAG_TILT,
    measured_state.SENSOR,
    intermittent.STATE_LOSS,
    gate_detection.SENSOR,
    intermittent.WRONG_GATE,
    image_motion.SENSOR,
    depth_cameras.STEREO,
    depth_cameras.TOF,
    intermittent.EXPOSURE,
    intermittent.FRAME_LOSS,
    imu.SENSOR,
    gate_filter.SENSOR,
)
"""The models in their order of application: each gets the output of the models before it."""
SENSORS: Registry[Sensor] = Registry(
    "sensor model",
    "diffracing_suite.sensors",
    {sensor.name: sensor for sensor in _BUILT_IN},
    _registration_error,
)
"""All sensor models by name, those of other packages included."""

Models = Mapping[str, Any]
"""Name of a model -> its values (the model's NamedTuple)."""


def view_models(models: Models) -> dict[str, Any]:
    """Return the models that change a view, with arrays as values, in the order of application."""
    return {
        name: as_arrays(models[name])
        for name, sensor in SENSORS.items()
        if name in models and sensor.sense
    }


def scale_model(name: str, values: Any, magnitude: Any) -> Any:
    """Return a model's values with their errors scaled by `magnitude`, within the bounds.

    The values are a NamedTuple of numbers. The `magnitude` is a number or an array (N,) for N
    drones. 0: no errors; 1: the given values.
    """
    sensor, changed = SENSORS.find(name), {}
    for parameter in sensor.parameters:
        if parameter.name in sensor.grows:
            neutral, low, high = parameter.neutral, parameter.low, parameter.high
            value = getattr(values, parameter.name)
            scaled = neutral + magnitude * (value - neutral)
            if hasattr(scaled, "__array_namespace__"):
                scaled = scaled.clip(low, high)
            else:
                scaled = min(max(scaled, low), high)
            changed[parameter.name] = scaled
    return values._replace(**changed)


def scale_models(models: Models, magnitude: Mapping[str, Any]) -> dict[str, Any]:
    """Return `models`, each scaled by its own magnitude; see `scale_model`."""
    return {name: scale_model(name, values, magnitude[name]) for name, values in models.items()}


def start(
    models: Models, truth: View, draws: Mapping[str, Draws], dt_s: Any, camera: Camera
) -> dict[str, Any]:
    """Return the state of each model at the first observation, by name.

    The models are `view_models`, the true views those of N drones, and observations `dt_s` apart
    [s].
    """
    return {
        name: begin(values, Moment(truth, draws[name], dt_s, camera))
        if (begin := SENSORS[name].start)
        else ()
        for name, values in models.items()
    }


def sense(
    models: Models,
    memory: Mapping[str, Any],
    truth: View,
    draws: Mapping[str, Draws],
    dt_s: Any,
    camera: Camera,
) -> tuple[View, dict[str, Any]]:
    """Apply all models to the true view.

    The models are `view_models`, and `memory` is from `start` or from the previous observation,
    `dt_s` before [s].

    Returns:
        The view with all errors, and the states of the models.
    """
    view, states = truth, dict[str, Any]()
    for name, values in models.items():
        apply = SENSORS[name].sense
        assert apply is not None
        view, states[name] = apply(
            values, memory[name], view, Moment(truth, draws[name], dt_s, camera)
        )
    return view, states
