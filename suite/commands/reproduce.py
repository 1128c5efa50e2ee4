"""The command `suite reproduce PAGE`: make a page of docs/results, such as the paper's table."""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, make_dataclass, replace
from pathlib import Path
from typing import Any

from suite.common.console import Console, duration
from suite.common.options import Advanced, Command, options
from suite.common.work import WorkersOption, read_workers_option
from suite.experiments import EXPERIMENTS, OVER_ALL
from tracks.common.grid import rich_table
from tracks.common.names import unknown_name


@dataclass(frozen=True)
class Config(Command):
    """Make one of the pages of docs/results; the same command again continues where it stopped.

    Pages: table2, robustness, perception, four_gates, ablation, schemes, faults, gpu, simulators.
    `all` makes the published ones, `status` lists the policies and code that are newer. suite
    reproduce alone prints a line about each, suite reproduce PAGE --help the options of a page.

    PAGE.json with the numbers, charts, and PAGE.md with the tables go to --out. If PAGE.md exists,
    only the part between its two comments is replaced.
    """

    out: Path = Path("runs/reproduce")
    """Folder of the page; docs/results in a checkout has the published ones."""
    cache: Advanced[Path] = Path("runs/reproduce/cache")
    """Folder of finished trials and trainings, shared by all pages."""
    workers: WorkersOption = None
    """Share trainings and flights among N processes of this machine, each with its share of the
    cores, or on the cluster at HOST:PORT, whose owner can run code here. Without it one training
    follows the other."""

    def written(self) -> list[Path]:
        """Return the folders that this command writes; while it runs, no other may write there.

        Without a page (`experiment`), and with `status`, it writes nothing.
        """
        from suite.experiments.published import Status

        is_page = not isinstance(getattr(self, "experiment", Status()), Status)
        return [self.out, self.cache] if is_page else []


def config_of(args: Sequence[str]) -> tuple[Any, str, list[str]]:
    """Return the configuration class of the page that `args` name, its name, and the other words.

    The class has the options of this command and those of the page, in the field `experiment`. Only
    the module of that page is loaded, because loading all of them takes seconds.

    Raises:
        ValueError: for an unknown page.
    """
    pages = {**EXPERIMENTS, **OVER_ALL}
    # The word after such an option is its value, also the `gpu` of `--out gpu`.
    valued = {option.flag for option in options(Config) if option.bare is not bool}
    pairs = enumerate(zip(["", *args], args, strict=False))
    index = next((k for k, (last, word) in pairs if word in pages and last not in valued), None)
    if index is None:
        if args and not args[0].startswith("-"):
            raise unknown_name("page", args[0], pages)
        return Config, "", list(args)
    name = args[index]
    if name in OVER_ALL:
        from suite.experiments import published

        experiment = getattr(published, name.capitalize())
    else:
        experiment = importlib.import_module(f"suite.experiments.{name}").Config
    field = ("experiment", experiment, experiment())
    namespace = {"__doc__": experiment.__doc__}
    kind = make_dataclass("Config", [field], bases=(Config,), namespace=namespace, frozen=True)
    return kind, name, [*args[:index], *args[index + 1 :]]


def run(config: Any, console: Console) -> dict[str, Any]:
    """Make the page, or continue an interrupted call; without a page list them."""
    from suite.experiments import published

    experiment = getattr(config, "experiment", None)
    if experiment is None:
        pages = {**EXPERIMENTS, **OVER_ALL}
        for name, summary in pages.items():
            console.say(f"{name:<12} {summary}")
        return {"pages": pages}
    if isinstance(experiment, published.Status):
        states = published.page_states(config.out)
        console.show(rich_table(published.status_grid(states)))
        return {"pages": states}
    if isinstance(experiment, published.All):
        from suite.cli import parse

        seconds: dict[str, float] = {}
        for name, words in published.PUBLISHED.items():
            own = [name, *words.split()]
            console.say(f"{len(seconds) + 1} of {len(published.PUBLISHED)}: {name}")
            started = time.monotonic()
            # The options of a page are parsed as in a command of its own.
            _, page = parse("reproduce", own)
            given = [part for word in sys.argv for part in (own if word == "all" else [word])]
            _make_page(replace(config, experiment=page.experiment), given, console)
            seconds[name] = round(time.monotonic() - started, 1)
            console.say(f"{name}: {duration(seconds[name])}")
        return {"seconds": seconds}
    return _make_page(config, sys.argv, console)


def _make_page(config: Any, words: Sequence[str], console: Console) -> dict[str, Any]:
    """Run the experiment of a page and write its files; return the page's numbers for --json.

    `words` are those of the command that makes this page, for its facts.
    """
    from suite.experiments.pages.document import Workspace, check_page, write_document
    from suite.experiments.study.options import check

    workers = read_workers_option(config.workers, whole_cores=True)
    check(config.experiment)
    workspace = Workspace(config.out, config.cache, workers)
    module = type(config.experiment).__module__
    name, document = module.rpartition(".")[2], importlib.import_module(module).document
    check_page(workspace.out, name)
    contents = document(config.experiment, workspace, console)
    return write_document(workspace, name, config.experiment, contents, words, console)
