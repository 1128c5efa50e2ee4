"""Chooses the flights, or the end of a single flight, that a diagnosis holds out of its fits.

Held-out flights test whether the named effects explain flights that no fit has seen.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eval.logs.flight_log import FlightLog
from suite.diagnose.data.flights import ViewFlights
from suite.diagnose.data.view import SmoothedFlight, smoothed
from suite.diagnose.data.windows import LENGTH_S
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

SmoothedFlights = dict[str, list[SmoothedFlight]]
"""Flights by name of the view."""


def choose_held_out(
    logs: Sequence[FlightLog],
    flight: np.ndarray,
    start_s: np.ndarray,
    information: np.ndarray,
    limits: Thresholds = THRESHOLDS,
) -> tuple[np.ndarray, list[str]]:
    """Return for each window (W,) whether it is fitted, and the names of the held-out flights.

    `information` (W, K) is that of each window on each of K parameters. Held out are flights whose
    information the others contain, too, so not the only chirp or the only pass near the ground. The
    choice does not depend on the errors. Of a single flight, the end is held out.
    """
    flight = np.asarray(flight)
    numbers = list(np.unique(flight))
    if len(numbers) == 1:
        # The share is of the windows, since signals may be missing in a part of the log.
        end_s = np.asarray(start_s) + LENGTH_S
        cut_s = float(np.quantile(end_s, limits.lone_fitted_share))
        is_fitted = end_s <= cut_s
        since_s = float(np.asarray(start_s)[~is_fitted].min(initial=cut_s))
        return is_fitted, [f"{logs[int(numbers[0])].name} from {since_s:.1f} s"]
    by_flight = {k: information[flight == k].sum(axis=0) for k in numbers}
    held: list[int] = []
    for _ in range(max(1, round(limits.held_out_share * len(numbers)))):
        kept = [k for k in numbers if k not in held]
        total = np.sum([by_flight[k] for k in kept], axis=0)
        informed = total > 0.0
        # The largest share of the information on any parameter that is lost without the flight.
        lost = {k: (by_flight[k][informed] / total[informed]).max(initial=0.0) for k in kept}
        held.append(min(reversed(kept), key=lambda k: lost[k]))
    return ~np.isin(flight, held), [logs[int(k)].name for k in sorted(held)]


def parted(
    flights: ViewFlights, held: Sequence[int], limits: Thresholds = THRESHOLDS
) -> tuple[SmoothedFlights, SmoothedFlights, list[str], list[str]]:
    """Return fitted flights, held-out flights, names of the latter, and notes in words.

    `held` are the numbers of the flights to hold out; a single flight is split in time. A second
    view with a part that is too short is left out, with a note.

    Raises:
        ValueError: if a part of the first view is too short.
    """
    names, notes = [log.name for log in flights.logs], list(flights.notes)
    fitted = [k for k in range(len(names)) if k not in held]
    fitted_part, held_part = (
        {name: [part[k] for k in numbers] for name, part in flights.smoothed.items()}
        for numbers in (fitted, held)
    )
    held_names = [names[k] for k in held]
    if len(names) == 1:
        # The share is of the time in flight, since a log may begin or end on the ground.
        flown_s = flights.smoothed[flights.views[0].name][0].form.middle_s
        until_s = float(np.quantile(flown_s, limits.lone_fitted_share))
        held_names = [f"{names[0]} from {until_s:.1f} s"]
        for view in flights.views:
            (single,) = flights.smoothed[view.name]
            early = single.rows.time_s <= until_s
            for part, chosen in ((fitted_part, early), (held_part, ~early)):
                rows = single.rows._replace(good=np.asarray(single.rows.good) & chosen)
                split = smoothed(view, rows, limits)._replace(reliability=single.reliability)
                part[view.name] = [split]
    for number, view in enumerate(flights.views):
        for what, part in (("to fit", fitted_part), ("held out", held_part)):
            flown_s = sum(len(one.form.middle_s) for one in part[view.name]) * view.spacing_s
            if flown_s >= limits.least_view_s:
                continue
            need = (
                f"{flown_s:.1f} s of usable flight {what}, at least {limits.least_view_s:g} s are "
                "needed: fly longer"
            )
            if number == 0:
                raise ValueError(f"{', '.join(names)}: {need}")
            notes.append(f"{view.name}: not examined, {need}")
            del fitted_part[view.name], held_part[view.name]
            break
    return fitted_part, held_part, held_names, notes
