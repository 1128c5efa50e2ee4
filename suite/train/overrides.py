"""Change settings of a run by name, as in `--set loss.progress=1.2`, also from one phase on.

A run is one training; a phase is a part of it that has the settings of the phase before, with
further changes. A user's change holds in every phase; `phases.2.loss.progress=2` holds from the
second phase on. The path of a setting is its name with those of the parts that it is in, such as
`loss.progress`.
"""

from __future__ import annotations

import ast
import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from suite.train.config import Phase, TrainConfig, check
from tracks.common.names import closest, unknown_name
from tracks.input.ranges import check_ranges, is_finite, shown

T = TypeVar("T")

POINT_MASS_ONLY = (
    "lag_mean",
    "lag_std",
    "drag",
    "drag_up",
    "wind_std",
    "time_step_std",
    "action_delay",
)
"""Settings of `physics` that only the point mass uses."""
WITHOUT_EFFECT = {
    "loss.projection_decay": ("loss.projection", 0.0),
    "loss.speed_range": ("spec.speed_input", False),
    "episode.race_share": ("spec.speed_input", False),
    "episode.stop_from": ("episode.rest_share", 0.0),
    "episode.start_speed": ("episode.rest_share", 1.0),
    "episode.missed_share": ("episode.rest_share", 1.0),
    "episode.density": ("episode.bare_share", 1.0),
    "sensors.magnitude": ("sensors.perfect_share", 1.0),
    "spec.speed": ("spec.speed_input", False),
}
"""Setting -> another setting, and the value of that with which the first one has no effect."""
ABSENT = {
    "quadrotor": "quadrotor; take a recipe that trains through quadrotors (suite train: or add "
    "--model quad and --vehicle)",
    "sensors": "sensor models; suite train: add --sensors",
}
"""Part of the settings that may be None -> text of the error if one of its settings is changed."""
FROM_FILES = {"quadrotor.vehicle": "--vehicle", "sensors.seen": "--sensors"}
"""Part of the settings that is the content of a file -> the option that names the file. It is not
changed by `--set`: the camera of a vehicle file, for example, has no effect on a training."""
OTHER_NAMES = [
    ("lr", "optimizer.rate"),
    ("learning_rate", "optimizer.rate"),
    ("num_envs", "episode.batch"),
]
"""(name that other trainers or an option of the command have for a setting, the setting's path)."""
KINDS: dict[type, str] = {int: "a whole number", float: "a number", str: "a text"}
"""Type of a setting -> what is allowed for it."""
PREFIX = "phases."
"""Prefix of a change that begins in a later phase."""


def _changed(config: T, changes: Iterable[str]) -> T:
    """Return `config` with the changes made, also those that have no effect."""
    for change in changes:
        path, separator, text = change.partition("=")
        if not separator:
            raise ValueError(f"--set {shown(change)}: write FIELD=VALUE, such as loss.progress=0.4")
        keys = path.strip().split(".")
        for part, option in FROM_FILES.items():
            if is_within(path.strip(), part):
                raise ValueError(
                    f"--set {shown(change)}: {part} comes from a file; give another file with "
                    f"{option}"
                )
        if keys[0] == "phases":
            raise ValueError(f"--set {shown(change)}: write phases.N.SETTING=VALUE with N from 1")
        _check_model(config, keys, shown(change))
        config = _with_value(config, keys, text.strip(), shown(change), config)
        check_ranges(config, f"--set {shown(change)}: ")
    return config


def path_of(change: str) -> str:
    """Return the path of the setting that a change PATH=VALUE sets."""
    return change.partition("=")[0].strip()


def _check_effective(phases: Sequence[object], path: str, change: str) -> None:
    """Refuse a setting that has no effect in any of the `phases` because of another one."""
    for name, (other, value) in WITHOUT_EFFECT.items():
        part, _, field = other.partition(".")
        if is_within(path, name) and all(
            getattr(getattr(phase, part, None), field, None) == value for phase in phases
        ):
            raise ValueError(
                f"--set {change}: {path} has no effect while {other} is {value!r}; set that as "
                "well, or leave this out"
            )


def is_within(path: str, part: str) -> bool:
    """Return whether a setting's path is `part` or below it."""
    return path == part or path.startswith(f"{part}.")


def _check_model(config: object, keys: list[str], change: str) -> None:
    """Refuse a setting of the point mass in a run that trains through quadrotors."""
    quadrotor = getattr(config, "quadrotor", None)
    if quadrotor is not None and keys[0] == "physics" and set(keys) & set(POINT_MASS_ONLY):
        raise ValueError(
            f"--set {change}: {'.'.join(keys)} is of the point mass, and this run goes through "
            "quadrotors; set one of quadrotor.* (suite train: or add --model point)"
        )


def check_owned(changes: Iterable[str], owned: Mapping[str, str]) -> None:
    """Refuse changes of settings that the command sets itself.

    Changes are PATH=VALUE, given with --set. `owned` maps the path of a setting, or of a part
    with all its settings, to advice for the message.

    Raises:
        ValueError: naming the setting and what to do instead.
    """
    for change in changes:
        path = path_of(phase_of(change)[1])
        for owned_path, advice in owned.items():
            if is_within(path, owned_path):
                raise ValueError(f"--set {shown(change)}: this command sets {path}; {advice}")


def _paths(config: Any, prefix: str = "") -> Iterator[str]:
    """Yield the paths of all settings in `config`, except those from files."""
    for field in dataclasses.fields(config):
        value, path = getattr(config, field.name), f"{prefix}{field.name}"
        if dataclasses.is_dataclass(value) and path not in FROM_FILES:
            yield from _paths(value, f"{path}.")
        else:
            yield path


def _with_value(config: T, path: list[str], text: str, change: str, root: object) -> T:
    """Return `config`, a part of `root`, with the value of the setting at `path` read from `text`.

    `change` is the user's text of the change, for messages.
    """
    if not dataclasses.is_dataclass(config) or isinstance(config, type):
        raise ValueError(f"--set {change}: {shown(path[0])} is below a setting that has no parts")
    name, *rest = path
    names = [field.name for field in dataclasses.fields(config)]
    if name not in names:
        ends = [(path.rpartition(".")[2], path) for path in _paths(root)] + OTHER_NAMES
        leaf = closest(name, [end for end, _ in ends])
        elsewhere = [path for end, path in ends if end == leaf]
        problem: object = unknown_name("setting", name, names)
        if elsewhere and (leaf == name or closest(name, names) is None):
            problem = f"unknown setting {shown(name)}. Did you mean {', '.join(elsewhere)}?"
        raise ValueError(
            f"--set {change}: {problem} suite train --list-settings prints all settings"
        )
    old = getattr(config, name)
    if old is None and name in ABSENT:
        raise ValueError(f"--set {change}: this run has no {ABSENT[name]}")
    if rest:
        return dataclasses.replace(config, **{name: _with_value(old, rest, text, change, root)})
    if dataclasses.is_dataclass(old):
        parts = ", ".join(field.name for field in dataclasses.fields(old))
        raise ValueError(f"--set {change}: {name!r} has parts, set one of {parts}")
    try:
        value = _value(old, text)
    except ValueError:
        several = "; separate settings by spaces, not by commas" if "=" in text else ""
        raise ValueError(
            f"--set {change}: {name} is {shown(text)}, allowed is {_allowed(old)}{several}"
        ) from None
    return dataclasses.replace(config, **{name: value})


def _value(old: object, text: str) -> object:
    """Return the value in `text` for a setting, which must have the type of the `old` value.

    Whole numbers are allowed for floats, and lists for tuples of the same length.

    Raises:
        ValueError: without a message, for a value of another type.
    """
    try:
        value = ast.literal_eval(text)
    # The parser fails in different ways on text that is nested a thousand times.
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        value = text
    if isinstance(old, float) and value == "inf":
        return math.inf
    if isinstance(old, tuple) and isinstance(value, (tuple, list)) and len(value) == len(old):
        return tuple(_value(a, repr(b)) for a, b in zip(old, value, strict=True))
    if isinstance(old, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value) if is_finite(value) else math.inf
    if type(value) is not type(old) or isinstance(old, tuple):
        raise ValueError
    return value


def _allowed(old: object) -> str:
    """Return what is allowed for a setting with the `old` value."""
    if isinstance(old, tuple):
        return f"a list of {len(old)}, such as {repr(old)[1:-1].replace(' ', '')}"
    return "True or False" if isinstance(old, bool) else f"{KINDS[type(old)]}, such as {old}"


def phase_ends(config: TrainConfig) -> tuple[int, ...]:
    """Return the number of gradient steps at the end of each phase."""
    total, share = config.optimizer.iterations, 0.0
    ends = []
    for phase in config.phases or (Phase(),):
        share += phase.share
        ends.append(min(total, round(share * total)))
    return tuple(ends)


def phase_configs(config: TrainConfig) -> tuple[TrainConfig, ...]:
    """Return the settings of each phase, as if the phase were a whole run.

    Raises:
        ValueError: for a change that cannot be made, naming the phase.
    """
    settings, configs, beginning = replace(config, phases=()), [], 0
    phases = config.phases or (Phase(),)
    for number, (phase, end) in enumerate(zip(phases, phase_ends(config), strict=True), 1):
        try:
            settings = _changed(settings, phase.set)
        except ValueError as error:
            raise ValueError(f"phase {number}: {error}") from error
        optimizer = replace(settings.optimizer, iterations=max(1, end - beginning))
        configs.append(replace(settings, optimizer=optimizer))
        beginning = end
    return tuple(configs)


def check_phases(config: TrainConfig) -> None:
    """Refuse a run with an invalid phase, before anything is compiled or written.

    Raises:
        ValueError: naming the setting, its value and what is allowed.
    """
    check(config)
    total = math.fsum(phase.share for phase in config.phases)
    if config.phases and not math.isclose(total, 1.0, abs_tol=1e-6):
        raise ValueError(f"the shares of phases add up to {total:g}, allowed is 1")
    common = _common_settings(config, config)
    for number, phase in enumerate(phase_configs(config), 1):
        check(phase)
        for key, value in _common_settings(phase, config).items():
            if value != common[key]:
                raise ValueError(
                    f"phase {number} changes {key}, which all phases of a run must share (of spec, "
                    "only rate_hz and speed may change); set it without a phase"
                )


def _common_settings(config: TrainConfig, run: TrainConfig) -> dict[str, object]:
    """Return the settings that all phases must share, by path.

    The rate and the speed of the policy may change. They are replaced by those of the `run`, so
    that they are equal in all phases.
    """
    spec = replace(config.spec, rate_hz=run.spec.rate_hz, speed=run.spec.speed)
    episode = config.episode
    return {"spec": spec, "episode.batch": episode.batch, "episode.shards": episode.shards,
            "seed": config.seed}  # fmt: skip


def with_changes(config: TrainConfig, changes: Iterable[str]) -> TrainConfig:
    """Return `config` with a user's changes, which hold in every phase or from one phase on.

    A change PATH=VALUE, such as "loss.progress=0.4", holds for every phase. "phases.2.PATH=VALUE"
    holds from the second phase until a later phase changes that setting. A change of spec.rate_hz
    without one of episode.steps keeps the length of rollouts [s].

    Raises:
        ValueError: naming the setting, what is wrong with it and what is allowed.
    """
    # A run's record does not depend on the order of changes of different settings.
    changes = sorted((change.strip() for change in changes), key=path_of)
    given = set[tuple[int, str]]()
    for change in changes:
        _check_phase(change, len(config.phases))
        number, rest = phase_of(change)
        if (setting := (int(number or 0), path_of(rest))) in given:
            raise ValueError(f"--set {shown(change)}: {setting[1]} is given twice; give it once")
        given.add(setting)
    in_all_phases = [change for change in changes if not change.startswith(PREFIX)]
    in_all_phases = [*_same_seconds(config, in_all_phases), *in_all_phases]
    # These replace the recipe's own changes in its phases, but not the user's.
    config = _changed(_without_phase_changes(config, map(path_of, in_all_phases)), in_all_phases)
    phases = list(config.phases)
    for index, phase in enumerate(config.phases):
        own = [rest for text, rest in map(phase_of, changes) if text and int(text) == index + 1]
        own = [*_same_seconds(phase_configs(config)[index], own), *own]
        phases[index] = replace(phase, set=(*phase.set, *own))
        config = replace(config, phases=tuple(phases))
    configs = phase_configs(config)
    for change in changes:
        number, rest = phase_of(change)
        _check_effective(configs[int(number or 1) - 1 :], path_of(rest), shown(change))
    return config


def phase_of(change: str) -> tuple[str, str]:
    """Return the number of the phase from which a change holds, "" for all, and the change."""
    if not change.startswith(PREFIX):
        return "", change
    number, _, rest = change.removeprefix(PREFIX).partition(".")
    return number, rest.strip()


def _check_phase(change: str, count: int) -> None:
    """Refuse a change from a phase on that cannot be made in a run with `count` phases."""
    number, rest = phase_of(change)
    if not change.startswith(PREFIX):
        return
    if not count:
        raise ValueError(f"--set {shown(change)}: this run has no phases; write SETTING=VALUE")
    if not (number.isdecimal() and 1 <= int(number) <= count):
        raise ValueError(
            f"--set {shown(change)}: this run has {count} phases; write phases.N.SETTING=VALUE "
            "with N from 1"
        )
    if path_of(rest) == "optimizer.iterations":
        raise ValueError(
            f"--set {shown(change)}: phases take shares of the run's gradient steps; set "
            "optimizer.iterations without a phase"
        )


def _same_seconds(config: TrainConfig, changes: Sequence[str]) -> list[str]:
    """Return further changes that keep rollouts and delays as long [s] if `changes` set the rate.

    There are none if `changes` also set the number of steps.
    """
    paths = set(map(path_of, changes))
    rate = [change for change in changes if path_of(change) == "spec.rate_hz"]
    if not rate or "episode.steps" in paths:
        return []
    same = at_rate(config, _changed(config, rate).spec.rate_hz)
    values: dict[str, object] = {
        "episode.steps": same.episode.steps,
        "episode.image_stride": same.episode.image_stride,
        "physics.state_delay": same.physics.state_delay,
        "physics.image_delay": same.physics.image_delay,
    }
    if config.quadrotor is None:
        values["physics.action_delay"] = same.physics.action_delay
    return [f"{path}={value!r}" for path, value in values.items() if path not in paths]


def at_rate(config: TrainConfig, rate_hz: float) -> TrainConfig:
    """Return `config` with decisions at `rate_hz`; rollouts and delays last as long as before [s].

    The delay of the point mass's commands is limited to two decisions.
    """
    ratio, physics, episode = rate_hz / config.spec.rate_hz, config.physics, config.episode
    stride = max(1, round(ratio * episode.image_stride))
    least, most = (min(2.0, ratio * delay) for delay in physics.action_delay)
    return replace(
        config,
        spec=replace(config.spec, rate_hz=rate_hz),
        physics=replace(
            physics,
            action_delay=(least, most),
            state_delay=round(ratio * physics.state_delay),
            image_delay=round(ratio * physics.image_delay),
        ),
        episode=replace(
            episode,
            image_stride=stride,
            steps=stride * max(1, round(ratio * episode.steps / stride)),
        ),
    )


def without_quadrotor(config: TrainConfig) -> TrainConfig:
    """Return `config` with training through the point mass instead of quadrotors."""
    return replace(_without_phase_changes(config, {"quadrotor"}), quadrotor=None)


def _without_phase_changes(config: TrainConfig, paths: Iterable[str]) -> TrainConfig:
    """Return `config` without the phases' changes of the settings (or parts) at `paths`."""
    removed = tuple(paths)

    def is_kept(change: str) -> bool:
        return not any(is_within(path_of(change), path) for path in removed)

    phases = (replace(phase, set=tuple(filter(is_kept, phase.set))) for phase in config.phases)
    return replace(config, phases=tuple(phases))
