"""`suite reproduce NAME`: the paper's tables and more, made by one command each."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar, Union

import tyro

from suite.common.console import Console
from suite.common.work import WorkersOption, workers_given
from suite.experiments import EXPERIMENTS, OVER_ALL
from tracks.common.grid import rich_table

Experiment = TypeVar("Experiment")


@dataclass(frozen=True)
class Unread:
    """Stands for the options of an experiment that a command line does not name."""


@dataclass(frozen=True)
class Config(Generic[Experiment]):
    """Make one of the documents of docs/results; the same command again continues where it stopped.

    NAME.json with the numbers, charts and NAME.md with the tables go to --out. Of a NAME.md that is
    there, what stands between its two comments is replaced.
    """

    experiment: Experiment
    """Which document."""
    out: Path = Path("runs/reproduce")
    """Folder of the document; docs/results in a checkout is where the published ones are."""
    cache: Path = Path("runs/reproduce/cache")
    """Folder of finished trials and trainings, shared by all documents."""
    workers: WorkersOption = None
    """Share trainings and flights among N processes of this machine, each with its share of the
    cores, or on the cluster at HOST:PORT, whose owner can run code here. Without it one training
    follows the other."""
    json: bool = False
    """Print one JSON object to standard output and nothing else."""


def config_type(args: Sequence[str]) -> Any:
    """Return what `args` are read into: the options of the experiments they name, and no others.

    An experiment brings what it needs with it, which takes longer than to read a command line.
    """
    kinds = [
        _options(name) if name in args else _summary(name, summary)
        for name, summary in {**EXPERIMENTS, **OVER_ALL}.items()
    ]
    asked = Config[Union[tuple(kinds)]]  # noqa: UP007  (made from the table)
    return Annotated[asked, tyro.conf.CascadeSubcommandArgs, tyro.conf.OmitSubcommandPrefixes]


def _options(name: str) -> Any:
    if name in OVER_ALL:
        from suite.experiments import published

        return Annotated[getattr(published, name.capitalize()), tyro.conf.subcommand(name)]
    config = importlib.import_module(f"suite.experiments.{name}").Config
    return Annotated[config, tyro.conf.subcommand(name)]


def _summary(name: str, summary: str) -> Any:
    return Annotated[Unread, tyro.conf.subcommand(name, description=summary)]


def written(config: Config[Any]) -> list[Path]:
    """Return the folders that the command writes into."""
    return [config.out, config.cache]


def run(config: Config[Any], console: Console) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write its document.

    Raises:
        ValueError: for anything that cannot be used, before the first flight.
    """
    from suite.experiments import published

    if isinstance(config.experiment, published.Status):
        states = published.page_states(config.out)
        console.show(rich_table(published.status_grid(states)))
        return {"pages": states}
    if isinstance(config.experiment, published.All):

        def make(name: str, options: Sequence[str]) -> dict[str, Any]:
            return _made(
                replace(config, experiment=tyro.cli(_options(name), args=options)), console
            )

        return published.make_all(make, console)
    return _made(config, console)


def _made(config: Config[Any], console: Console) -> dict[str, Any]:
    from suite.experiments.pages.document import Place, check_page, write_document
    from suite.experiments.study.options import check

    workers = workers_given(config.workers, whole_cores=True)
    check(config.experiment)
    place, module = Place(config.out, config.cache, workers), type(config.experiment).__module__
    name, document = module.rpartition(".")[2], importlib.import_module(module).document
    check_page(place.out, name)
    made = document(config.experiment, place, console)
    return write_document(place, name, config.experiment, made, console)
