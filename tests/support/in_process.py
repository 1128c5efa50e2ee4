"""A model's engine in the test's own process, where a new one each time is only slow."""

import importlib

import numpy as np

from policies.formats.model_process import REMEDIES, Port
from policies.formats.model_server import KINDS
from policies.spec import NoAnswer, PolicyError


class InProcess:
    """Stands for `ModelProcess`, with its answers and its words where the engine refuses."""

    def __init__(self, model, where, kind, labels=()):
        name, load = KINDS[kind]
        engine = importlib.import_module(name)
        self._where = where
        try:
            about, self._run = load(engine, model, labels)
        except Exception as error:
            raise PolicyError(
                f"{where}: {name} {engine.__version__} cannot load it ({error}); {REMEDIES[name]}"
            ) from None
        self.labels = about.get("labels", {})
        self.inputs, self.outputs = (
            [Port(port, number, tuple(shape)) for port, number, shape in about[side]]
            for side in ("inputs", "outputs")
        )

    def run(self, feed):
        arrays = {name: np.ascontiguousarray(value, np.float32) for name, value in feed.items()}
        try:
            return [np.ascontiguousarray(value) for value in self._run(arrays)]
        except Exception as error:
            raise NoAnswer(f"{self._where}: fails while it runs ({error})") from None
