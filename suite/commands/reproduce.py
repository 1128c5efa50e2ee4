"""`suite reproduce NAME`: the paper's tables and more, made by one command each."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Union

import tyro

from suite.common.console import Console
from suite.common.work import WorkersOption, asked_workers
from suite.experiments import EXPERIMENTS

if TYPE_CHECKING:
    Experiment = Any
else:
    Experiment = Union[  # noqa: UP007  (made from the table)
        tuple(
            Annotated[
                importlib.import_module(f"suite.experiments.{name}").Config,
                tyro.conf.subcommand(name),
            ]
            for name in EXPERIMENTS
        )
    ]


@tyro.conf.configure(tyro.conf.CascadeSubcommandArgs, tyro.conf.OmitSubcommandPrefixes)
@dataclass(frozen=True)
class Config:
    """Make one of the documents of docs/results; the same command again goes on where it stopped.

    NAME.md, its figures and NAME.json with the numbers go to --out.
    """

    experiment: Experiment
    """Which document."""
    out: Path = Path("runs/reproduce")
    """Folder of the document; docs/results in a checkout is where the published ones are."""
    cache: Path = Path("runs/reproduce/cache")
    """Folder of finished trials and trainings, shared by all documents."""
    workers: WorkersOption = None
    """Trainings and flights at once: N processes of this machine, each with its own share of the
    cores, or ADDRESS, a cluster's. Without it one training after the other."""
    json: bool = False
    """Print one JSON object to standard output and nothing else."""


def written(config: Config) -> list[Path]:
    """Return the folders that the command writes into."""
    return [config.out, config.cache]


def run(config: Config, console: Console) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write its document.

    Raises:
        ValueError: for anything that cannot be used, before the first flight.
    """
    from suite.experiments.pages.document import Place, write_document
    from suite.experiments.study.options import check

    workers = asked_workers(config.workers, whole_cores=True)
    check(config.experiment)
    place, module = Place(config.out, config.cache, workers), type(config.experiment).__module__
    name, document = module.rpartition(".")[2], importlib.import_module(module).document
    report, numbers = document(config.experiment, place, console)
    return write_document(place, name, config.experiment, report, numbers, console)
