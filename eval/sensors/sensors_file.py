"""Read, check and write sensors files (TOML), which list sensor models with their parameters.

Each model has a table named after what it changes ([state], [gates], [depth] or [imu]; several as
[[state]]), whose `kind` is the model's name. A parameter that is left out has its neutral value,
which gives no error.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from eval.sensors import SENSORS, scale_model
from eval.sensors.interface import STAGES, Ages, Sensor
from tracks.common.files import write_text
from tracks.common.toml_table import Table, load_shipped, shipped_names, to_toml, toml_head

SCHEMA = 1
"""Version of the file format."""
PRESETS = Path(__file__).resolve().parent / "presets"
"""Folder of the sensors files that come with the suite."""
NO_AGES = Ages()
"""Ages of an observation without delay."""


class SensorsFileError(ValueError):
    """An unusable sensors file; the message has the key and what is allowed."""


@dataclass(frozen=True)
class SensorSet:
    """A set of sensor models; without models the observation is the truth."""

    name: str = "perfect"
    """Name of the set in tables of results."""
    models: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    """Name of a model in `eval.sensors.SENSORS` -> its values, a NamedTuple of numbers."""

    def __getstate__(self) -> dict[str, Any]:
        """Return a picklable state, since a read-only view of a dict is not picklable."""
        return {**vars(self), "models": dict(self.models)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, models=MappingProxyType(state["models"]))

    @property
    def ages(self) -> Ages:
        """Ages of the observation when the policy uses it, by the model `delay`."""
        for name, values in self.models.items():
            ages_of = SENSORS[name].ages
            if ages_of:
                return ages_of(values)
        return NO_AGES

    @property
    def has_delay(self) -> bool:
        """Whether the state or the image is delayed."""
        return bool(self.ages.state_s or self.ages.image_s)

    @property
    def estimator(self) -> Any:
        """Settings of the state estimator that feeds the policy; None without one."""
        for name, values in self.models.items():
            settings_of = SENSORS[name].estimate
            if settings_of:
                return settings_of(values)
        return None

    @property
    def without_effect(self) -> list[str]:
        """Names of models that add no errors, since the sizes of all their errors are neutral."""
        found = []
        for name, values in self.models.items():
            sensor = SENSORS[name]
            sizes = [entry for entry in sensor.parameters if entry.name in sensor.grows]
            if sizes and sensor.estimate is None:
                found += [name] * all(getattr(values, p.name) == p.neutral for p in sizes)
        return found

    @property
    def random(self) -> bool:
        """Whether what a policy observes depends on the trial's seed."""
        sensors = [SENSORS[name] for name in self.models]
        draws = any(any(s.trial + s.observation) for s in sensors if s.sense)
        return draws or self.estimator is not None or (self.has_delay and self.ages.jitter > 0)


PERFECT = SensorSet()
"""The set without errors: the policy observes the truth."""


def sensor_set(models: Mapping[str, Mapping[str, float]], name: str = "custom") -> SensorSet:
    """Return a checked set of models from the parameters that differ from neutral.

    Raises:
        ValueError: as in `parse_sensors`.
    """
    return parse_sensors(_table(name, models))


def scale_sensors(sensors: SensorSet, magnitude: float) -> SensorSet:
    """Return `sensors` with their errors scaled by `magnitude`; 0: the truth, 1: unchanged."""
    if magnitude in (0.0, 1.0):
        return sensors if magnitude else PERFECT
    models = {name: scale_model(name, values, magnitude) for name, values in sensors.models.items()}
    return SensorSet(f"{sensors.name} x {magnitude:g}", MappingProxyType(models))


def shipped_sensors() -> list[str]:
    """Return the names of the sensors files that come with the suite."""
    return shipped_names(PRESETS)


def load_sensors(source: str | os.PathLike[str]) -> SensorSet:
    """Return the sensors of a file, or shipped ones by their name.

    A text counts as a path if it ends in .toml, has a folder or is an existing file.

    Raises:
        SensorsFileError: for an unusable file.
        ValueError: for a name that is neither a file nor a shipped set.
    """
    return load_shipped(source, PRESETS, "sensors", parse_sensors, SensorsFileError)


def parse_sensors(table: Mapping[str, Any]) -> SensorSet:
    """Return the sensors that a file's `table` describes.

    Raises:
        ValueError: with the key, the value and what is allowed.
    """
    top = Table("", "", table)
    top.expect(("name", "schema", *STAGES))
    if top.whole("schema", SCHEMA) != SCHEMA:
        raise top.error("schema", table["schema"], f"{SCHEMA}: this version of the suite reads it")
    values_of: dict[str, Any] = {}
    for stage in STAGES:
        single = isinstance(table.get(stage), Mapping)
        for entry in [top.table(stage)] if single else top.tables(stage):
            sensor = SENSORS.find(entry.text("kind"))
            if sensor.stage != stage:
                raise entry.error("kind", sensor.name, f"a model of [{stage}]; put this one under "
                                  f"[[{sensor.stage}]]")  # fmt: skip
            if sensor.name in values_of:
                raise entry.error("kind", sensor.name, "each model once")
            values_of[sensor.name] = _values(sensor, entry)
    models = {name: values_of[name] for name in SENSORS if name in values_of}
    return SensorSet(top.text("name", "custom"), MappingProxyType(models))


def _values(sensor: Sensor, table: Table) -> Any:
    """Return the parameters of a model from its table, checked against their bounds."""
    table.expect(("kind", *(parameter.name for parameter in sensor.parameters)))
    return sensor.values(
        *(table.number(p.name, p.neutral, least=p.low, most=p.high) for p in sensor.parameters)
    )


def sensors_table(sensors: SensorSet) -> dict[str, Any]:
    """Return `sensors` as the nested table of their file."""
    models = {name: values._asdict() for name, values in sensors.models.items()}
    return _table(sensors.name, models)


def _table(name: str, models: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Return the parameters of `models` as the nested table of a sensors file."""
    stages: dict[str, list[dict[str, Any]]] = {}
    for kind, values in models.items():
        stages.setdefault(SENSORS.find(kind).stage, []).append({"kind": kind, **values})
    return {"name": name, "schema": SCHEMA, **stages}


def save_sensors(sensors: SensorSet, path: str | os.PathLike[str], comment: str = "") -> None:
    """Write `sensors` as a file that `load_sensors` reads back equal; after an error, no file.

    The sensors are checked like a file. The file begins with the lines of `comment`,
    and with the versions that wrote it.

    Raises:
        ValueError: for sensors that `load_sensors` would reject.
    """
    table = sensors_table(sensors)
    parse_sensors(table)
    write_text(path, toml_head(comment, SCHEMA) + to_toml(table))
