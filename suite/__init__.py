"""Train, judge and diagnose drone racing policies: the command line and the Python interface.

The names in `__all__` are the stable interface; all other modules may change between versions.
Other packages are imported at the first use of a name, so that `import suite` takes no time.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tracks.input.ranges import PATH, Range, as_path, check_number, check_type

if TYPE_CHECKING:
    import gymnasium

    from eval.effects.interface import Effect
    from eval.logs.flight_log import read_flight, write_flight
    from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
    from eval.vehicles.vehicle import Vehicle
    from eval.worlds.trial import TrialResult
    from policies.policy import Policy, load_policy
    from suite.common.console import Console
    from tracks.families import make_track
    from tracks.formats.custom import load_track
    from tracks.track import Track

__all__ = [
    "diagnose_flights",
    "evaluate_policy",
    "identify_vehicle",
    "load_policy",
    "load_track",
    "load_vehicle",
    "make_env",
    "make_track",
    "read_flight",
    "register_effect",
    "register_simulator",
    "register_track",
    "save_vehicle",
    "train_policy",
    "write_flight",
]

_MODULES = {
    "load_policy": "policies.policy",
    "load_track": "tracks.formats.custom",
    "load_vehicle": "eval.quadrotor.vehicle_file",
    "make_track": "tracks.families",
    "read_flight": "eval.logs.flight_log",
    "save_vehicle": "eval.quadrotor.vehicle_file",
    "write_flight": "eval.logs.flight_log",
}
"""Name -> the module that defines it."""

Source = str | Path
"""A shipped name or a path."""


def evaluate_policy(
    policy: Policy | Source = "race",
    *,
    track: str | Track = "all",
    difficulty: str | int = "0,3",
    trials: int = 10,
    seed: int = 0,
    vehicle: Vehicle | Source = "reference",
    simulator: str = "mujoco",
    sensors: str | Path = "perfect",
    workers: int | None = None,
) -> list[TrialResult]:
    """Fly trials and return their results, as `suite eval` does; its warnings are Python warnings.

    Args:
        policy: a policy (`load_policy`, or any object with its methods), a shipped name or a file.
        track: a track or track file of your own, "all" (the judged families), a family, or several
            with commas.
        difficulty: a level 0 to 9, "0,3", "0-9" or "all"; ignored for a track of your own.
        trials: number of trials on every track at every level. A track of your own is flown once if
            nothing in its flights is random; policy objects may be random. In results a Track that
            `make_track` drew has the name FAMILY-LEVEL-SEED.
        seed: seed of the first trial; each further trial adds one.
        vehicle: a vehicle, a shipped name or a vehicle file.
        simulator: a name of `suite list simulators`.
        sensors: what the policy sees and knows: a shipped name or a sensors file.
        workers: number of processes; None takes one. Several processes import the program again,
            so it must call this function below `if __name__ == "__main__":`, and register effects,
            tracks and simulators above it.

    Raises:
        ValueError: for an argument that cannot be used, before the first flight.
    """
    from eval.judging.policy_checks.faults import notes_of, notes_of_file, object_faults
    from eval.judging.policy_checks.in_flight import action_report
    from eval.logs.faults.vehicle import vehicle_doubts
    from eval.quadrotor.vehicle_file import checked_vehicle
    from eval.vehicles.vehicle import Vehicle
    from eval.worlds.engine import warn_of
    from policies.policy import check_is_policy, load_policy
    from suite.common.vehicles import camera_warnings
    from suite.judging.content import PolicyContent
    from suite.judging.flying import fly_from_python
    from suite.judging.requests import Evaluation
    from suite.judging.trials import equal_flights, read_trial_set
    from tracks.common.work import MOST
    from tracks.formats.custom import load_track
    from tracks.track import Track

    check_type("track", track, (*PATH, Track), "a text, a path or a Track; several in one text "
               "with commas")  # fmt: skip
    check_type("difficulty", difficulty, (str, Integral), "a level, or several as a text: '0,3'")
    check_type("vehicle", vehicle, (*PATH, Vehicle), "a name, a path or a Vehicle")
    check_type("sensors", sensors, PATH, "a name or a path")
    if workers is not None:
        check_number("workers", workers, Range(1, MOST, whole=True))
    if isinstance(vehicle, Vehicle):
        checked_vehicle(vehicle)
    loaded = load_policy(policy) if isinstance(policy, PATH) else policy
    check_is_policy(loaded)
    if isinstance(track, os.PathLike) and "," in os.fspath(track):
        track = load_track(track)  # in a text commas separate tracks
    given: dict[str, Any] = {"track": track, "vehicle": vehicle}
    sources = {name: os.fspath(each) for name, each in given.items() if isinstance(each, PATH)}
    objects = {name: each for name, each in given.items() if name not in sources}
    request: dict[str, Any] = {
        "difficulty": str(difficulty),
        "sensors": os.fspath(sensors),
        **sources,
    }
    is_source = isinstance(policy, PATH)
    with _options_as_arguments("trials", "seed", "simulator", *request):
        evaluation = Evaluation(trials=trials, seed=seed, simulator=simulator, **request)
        trial_set = read_trial_set(evaluation, repeated=not is_source, **objects)
    before = notes_of(loaded)
    notes = dict.fromkeys([*before, *trial_set.notes])
    cameras = camera_warnings(loaded.spec.camera, trial_set.vehicle)
    doubts_of_files = [*vehicle_doubts(trial_set.vehicle), *cameras]
    warn_of([*doubts_of_files, *trial_set.differences, *notes])
    processes = 1 if workers is None else workers
    content = PolicyContent.of(policy) if is_source else None
    results = fly_from_python(loaded, content, evaluation, trial_set, processes)
    # An object is probed after its flights, so that the probe cannot change them.
    is_tested = before or notes_of_file(loaded) is not None
    doubts = () if is_tested else object_faults(loaded)
    known = {doubt.fault for doubt in doubts}
    in_flight = action_report(results, loaded.spec.action, known)["warnings"]
    warn_of(f"policy {loaded.name!r}: {doubt}" for doubt in (*doubts, *in_flight))
    warn_of(equal_flights(results, trial_set.tracks))
    return results


def train_policy(
    out: Source,
    recipe: str = "race",
    *,
    settings: str | Sequence[str] = (),
    iterations: int | None = None,
    seed: int = 0,
    progress: bool = True,
) -> Path:
    """Train a policy, or resume the training in `out`, and return the policy's folder.

    Args:
        out: folder of the run.
        recipe: a name of `suite list recipes`.
        settings: changes as `suite train --set` takes them, such as "loss.progress=2".
        iterations: number of gradient steps; None takes the recipe's.
        seed: seed of the parameters, tracks and randomisation.
        progress: print progress.

    Raises:
        ValueError: for a recipe or setting that cannot be used, or a folder with another run, or
            in which another program writes.
    """
    from eval.worlds.engine import warn_of
    from suite.commands.train import Config, doubts, resolve
    from suite.common.provenance import refuse_policy_folder
    from suite.common.running.lock import one_writer
    from suite.train.run import train
    from tracks.input.ranges import check_ranges

    folder = as_path("out", out)
    changes = _all("settings", settings, "a text such as 'loss.progress=2'")
    with _options_as_arguments("seed", "iterations", "out", set="settings"):
        config = Config(recipe=recipe, iterations=iterations, set=changes, seed=seed)
        check_ranges(config, options=True)
        resolved = resolve(config)
        refuse_policy_folder(folder)
        with one_writer(folder), _precision_of_commands():
            warn_of(doubts(resolved, changes))
            outcome = train(resolved, folder, _console(progress))
    return Path(outcome.policy)


def diagnose_flights(
    flights: Source | Sequence[Source],
    vehicle: Source,
    out: Source,
    *,
    reference: Source | Sequence[Source] = (),
    accept: str | Sequence[str] = (),
    progress: bool = True,
) -> dict[str, Any]:
    """Name the physical effect that a vehicle file lacks; return the contents of diagnosis.json.

    Args:
        flights: flight logs or folders of them: one, or a sequence.
        vehicle: a vehicle file or a shipped name.
        out: folder for diagnosis.json, vehicle.toml and report.html.
        reference: earlier flights; with them the diagnosis names what has changed since.
        accept: faults of the logs that do not stop it, by the names that its message gives.
        progress: whether to print progress.

    Raises:
        ValueError: for flights or a vehicle that cannot be used, or a folder in which another
            program writes.
    """
    from suite.common.running.lock import one_writer
    from suite.diagnose.config import Config
    from suite.diagnose.run import diagnose_files

    paths, before = (
        tuple(as_path(name, entry) for entry in _all(name, given))
        for name, given in (("flights", flights), ("reference", reference))
    )
    file, folder = str(as_path("vehicle", vehicle)), as_path("out", out)
    faults = _all("accept", accept, "the name of a fault")
    config = Config(flights=paths, vehicle=file, reference=before, out=folder, accept=faults)
    with _options_as_arguments("out", "accept"), one_writer(folder), _precision_of_commands():
        return diagnose_files(config, _console(progress))


def identify_vehicle(
    flights: Source | Sequence[Source],
    vehicle: Source,
    out: Source,
    *,
    accept: str | Sequence[str] = (),
    progress: bool = True,
) -> dict[str, Any]:
    """Estimate the parameters of a vehicle file from flights, and return them with intervals.

    Args:
        flights: flight logs or folders of them: one, or a sequence.
        vehicle: the file or shipped name to start from.
        out: the vehicle file to write (.toml), another one than `vehicle`.
        accept: faults of the logs that do not stop it, by the names that its message gives.
        progress: whether to print progress and warnings.

    Raises:
        ValueError: for flights or a vehicle that cannot be used.
    """
    from suite.diagnose.identify.run import identify_files

    paths = [as_path("flights", entry) for entry in _all("flights", flights)]
    faults = _all("accept", accept, "the name of a fault")
    start, file, console = str(as_path("vehicle", vehicle)), as_path("out", out), _console(progress)
    with _options_as_arguments("out", "accept"), _precision_of_commands():
        result = identify_files(paths, start, file, (), console, faults)
    for warning in result["warnings"]:
        console.note(f"warning: {warning}")
    return result


def _all(name: str, given: Any, allowed: str = "a text or a path") -> tuple[Any, ...]:
    """Return the argument `name`, one text or path or a sequence of them, as a tuple."""
    is_several = isinstance(given, Iterable) and not isinstance(given, str | bytes | Mapping)
    entries = tuple(given) if is_several else (given,)
    for entry in entries:
        as_path(name, entry, f"{allowed}, or a sequence of these")
    return entries


def make_env(**settings: Any) -> gymnasium.Env[Any, Any]:
    """Return the gymnasium environment `diffracing/Race-v0`; see `eval.envs.gymnasium_env`."""
    import gymnasium

    from eval.envs.gymnasium_env import ID

    mode = settings.get("render_mode")
    check_type("render_mode", mode, (str, type(None)), "None or 'rgb_array'")
    return gymnasium.make(ID, **settings)


def register_effect(effect: Effect) -> None:
    """Add a physical effect to the catalogue, for this process.

    Raises:
        ValueError: for a name in use, or an effect with inconsistent parts.
    """
    from eval.effects import EFFECTS
    from eval.effects.interface import Effect

    check_type("effect", effect, (Effect,), "an Effect")
    EFFECTS.register(effect.name, effect)


def register_track(name: str, make: Any) -> None:
    """Add a track family for this process: a function make(difficulty, rng) -> Layout.

    Raises:
        ValueError: for a name in use, or a `make` that is no such function.
    """
    from tracks.families import FAMILIES

    if isinstance(name, str) and name == "all":
        raise ValueError("name is 'all', which means the judged families; register another name")
    FAMILIES.register(name, make)


def register_simulator(name: str, simulator: Any) -> None:
    """Add a simulator, a class as `eval.worlds.World` describes it, for this process.

    Raises:
        ValueError: for a name in use, or a simulator that is no class or lacks methods.
    """
    from eval.worlds import WORLDS

    if missing := ", ".join(sorted(getattr(simulator, "__abstractmethods__", ()))):
        raise ValueError(f"simulator {name!r}: {simulator.__name__} lacks its methods {missing}")
    WORLDS.register(name, simulator)


@contextmanager
def _options_as_arguments(*same: str, **others: str) -> Iterator[None]:
    """Name arguments of Python, not options of a command, in the message of a ValueError."""
    try:
        yield
    except ValueError as error:
        text = str(error)
        for option, argument in {**dict(zip(same, same, strict=True)), **others}.items():
            text = re.sub(rf"--{option}\b(?!-)", argument, text)
        if text != str(error):
            error.args = (text,)
        raise


@contextmanager
def _precision_of_commands() -> Iterator[None]:
    """Compute as commands do, whatever precision the calling program has chosen in JAX."""
    import jax

    with jax.enable_x64(False), jax.default_matmul_precision("highest"):
        yield


def _console(progress: bool) -> Console:
    from suite.common.console import Console, Silent

    return Console() if progress else Silent()


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_MODULES])
