"""Takes some rows of a flight log."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from eval.logs.flight_log import FlightLog


def take_rows(log: FlightLog, chosen: np.ndarray, **changed: Any) -> FlightLog:
    """Return the rows `chosen` (indices, or (T,) bool) of a log, with `changed` fields."""
    taken: dict[str, Any] = {
        name: values[chosen] for name, values in vars(log).items() if isinstance(values, np.ndarray)
    }
    taken["extra"] = {name: values[chosen] for name, values in log.extra.items()}
    return replace(log, **{**taken, **changed})
