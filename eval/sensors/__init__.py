"""The catalogue of sensor models: errors of state estimates, gate positions, depth images and IMU.

To add a model, write its `Sensor` and list it here. Another package adds one with an entry point of
the group `diffracing_suite.sensors`; a program adds one for its own process with
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


def _wrong(name: str, sensor: Any) -> str | None:
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
    return None


_OWN = (
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
"""In the order of application; each model gets the output of those before it."""
SENSORS: Registry[Sensor] = Registry(
    "sensor model", "diffracing_suite.sensors", {sensor.name: sensor for sensor in _OWN}, _wrong
)

Models = Mapping[str, Any]
"""Values (the model's NamedTuple) by the model's name."""


def sensing(models: Models) -> dict[str, Any]:
    """Return those of `models` that change a view, as arrays, in the order of application."""
    return {
        name: as_arrays(models[name])
        for name, sensor in SENSORS.items()
        if name in models and sensor.sense
    }


def scaled(name: str, values: Any, magnitude: Any) -> Any:
    """Return a model's values with their errors scaled by `magnitude`, within the bounds.

    Args:
        name: of the model.
        values: its NamedTuple of numbers.
        magnitude: 0: no errors; 1: `values`; a number, or an array (N,) for N rows.
    """
    sensor, grown = SENSORS.find(name), {}
    for parameter in sensor.parameters:
        if parameter.name in sensor.grows:
            neutral, value = float(parameter.neutral), getattr(values, parameter.name)  # pyright: ignore[reportArgumentType]
            changed = neutral + magnitude * (value - neutral)
            if hasattr(changed, "__array_namespace__"):
                changed = changed.clip(parameter.low, parameter.high)
            else:
                changed = min(max(changed, parameter.low), parameter.high)
            grown[parameter.name] = changed
    return values._replace(**grown)


def magnified(models: Models, magnitude: Mapping[str, Any]) -> dict[str, Any]:
    """Return `models`, each scaled by its own magnitude with `scaled`."""
    return {name: scaled(name, values, magnitude[name]) for name, values in models.items()}


def start(
    models: Models, truth: View, draws: Mapping[str, Draws], dt_s: Any, camera: Camera
) -> dict[str, Any]:
    """Return the state of each of `models` (of `sensing`) at the first observation.

    Args:
        models: values by name.
        truth: (N, ...) the true view.
        draws: of the trials, by model.
        dt_s: time between observations [s].
        camera: the policy's.
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
    """Return the view after all of `models`, and their states; arguments as in `start`."""
    seen, kept = truth, dict[str, Any]()
    for name, values in models.items():
        apply = SENSORS[name].sense
        assert apply is not None
        seen, kept[name] = apply(
            values, memory[name], seen, Moment(truth, draws[name], dt_s, camera)
        )
    return seen, kept
