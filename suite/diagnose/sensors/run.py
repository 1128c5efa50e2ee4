"""From flight logs with an estimate and a reference to a sensors file that the judge flies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from eval.judging.statistics import Interval
from eval.logs.columns import FlightLogError
from eval.logs.flight_log import read_flights
from eval.sensors import SENSORS
from eval.sensors.sensors_file import save_sensors, sensor_set
from suite.common.console import Console
from suite.common.provenance import stamp
from suite.delta.run import flight_files
from suite.diagnose.identify.numbers import Number, as_json, lines_of_numbers
from suite.diagnose.sensors.errors import errors_of
from suite.diagnose.sensors.identify import WITHIN, fit_sensors, held_out, parameters_of
from suite.diagnose.sensors.lateness import acting

SCHEMA = 1


def identify_sensors(flights: Sequence[Path], out: Path, console: Console) -> dict[str, Any]:
    """Fit a sensors model to the estimates in flight logs, and write its file.

    Args:
        flights: logs or folders of them; those without an estimate are named and left out.
        out: the sensors file to write.
        console: for people.

    Returns:
        What `--json` prints.

    Raises:
        ValueError: where no log holds both an estimate and a reference.
    """
    logs, warnings = read_flights(flight_files(flights), partial=True)
    used, seconds, refused = [], 0.0, []
    for log in logs:
        try:
            errors = errors_of(log)
            used.append(log)
            seconds += len(errors.value) * errors.step_s
        except FlightLogError as error:
            refused.append(str(error))
    if not used:
        raise ValueError("no flight can be used:\n" + "\n".join(refused))
    warnings += [f"not used: {text}" for text in refused]
    console.say(f"{len(used)} flights with an estimate and a reference, {seconds:.0f} s in all")
    fitted, checked = fit_sensors(used), held_out(used)
    if not fitted.axes:
        raise ValueError(
            "no axis of the estimate has two stretches of 5 s without a hole; fly longer, or log "
            "the estimate and the reference in the same rows"
        )
    parameters = parameters_of(fitted)
    head = [f"An on-board estimate against a reference in {len(used)} flights; 95 % intervals:"]
    numbers = [
        Number(key, unit, [one.value], [(one.low, one.high)])
        for key, (one, unit) in parameters.items()
    ]
    head += lines_of_numbers(numbers)
    save_sensors(sensor_set(_values(parameters), out.stem), out, "\n".join(head))
    return {
        "sensors": str(out),
        "parameters": as_json(numbers),
        "delay_by_part": {k: list(one) for k, one in fitted.lateness.by_part.items()},
        "held_out": {
            axis: {**one._asdict(), "fits": one.fits, "within": WITHIN}
            for axis, one in checked.items()
        },
        "flights": [log.name for log in used],
        "warnings": warnings,
        **stamp(SCHEMA, None),
    }


def say_held_out(result: Mapping[str, Any], console: Console) -> None:
    """Print how the model fits flights that it was not fitted to."""
    if result["held_out"]:
        console.say("autocorrelation up to 1 s on flights that the model was not fitted to:")
    for axis, one in result["held_out"].items():
        fits = "fits" if one["fits"] else "does not fit"
        console.say(
            f"  {axis} {fits}: {one['fitted']:.2f}, measured {one['measured']:.2f}, at a lag of "
            f"{one['lag_s']:.2f} s where they differ most (allowed {one['within']:g})"
        )


def _values(parameters: Mapping[str, tuple[Interval, str]]) -> dict[str, dict[str, float]]:
    """Return what the file says: a delay, scale or drift that may be none is left out."""
    models: dict[str, dict[str, float]] = {}
    for key, (one, _) in parameters.items():
        model, name = key.split(".")
        noise = model == "measured_state" and name not in ("velocity_scale", "position_drift")
        value = one.value if noise else acting(one)
        limits = next(p for p in SENSORS.find(model).parameters if p.name == name)
        value = min(max(value, float(limits.low)), float(limits.high))  # pyright: ignore[reportArgumentType]
        if noise or value:
            models.setdefault(model, {})[name] = float(f"{value:.4g}")
    return models
