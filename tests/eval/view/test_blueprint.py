"""A recording opens laid out: a tab a trial, and the time before the first gate."""

import rerun.chunk

from tests.support.flights import rollout
from tests.support.recordings import columns


def test_a_recording_opens_laid_out(recorded):
    path, _ = recorded
    reader = rerun.chunk.RrdReader(path)
    (blueprint,) = reader.blueprints()
    (data,) = reader.recordings()
    assert blueprint.application_id == data.application_id
    found = columns(path, blueprint)
    by_name = {name: [] for _, name in found}
    for (_, name), (_, values) in found.items():
        by_name[name].append(values[0][0])
    kinds = by_name["ViewBlueprint:class_identifier"]
    # Two trials: two 3D views each, five plots, the events; only the first one saw depth images.
    counts = {kind: kinds.count(kind) for kind in set(kinds)}
    assert counts == {"3D": 4, "2D": 1, "TimeSeries": 10, "TextLog": 2}
    origins = set(by_name["ViewBlueprint:space_origin"])
    assert {"/trial_0/world", "/trial_0/world/drone/camera", "/trial_1/speed"} <= origins
    shown = {entity for entity, _ in columns(path)}
    assert all(any(entity.startswith(origin) for entity in shown) for origin in origins)
    # It plays from just before the first gate, with the time in sight.
    flight = rollout()[1]
    gate_s = flight.time_s[flight.gate > 0][0]
    (shown,) = by_name["TimePanelBlueprint:time_selection"]
    begin, end = shown["min"] / 1e9, shown["max"] / 1e9
    assert max(0.0, gate_s - 1.0) <= begin < gate_s < end
    assert by_name["PanelBlueprint:state"] or by_name["TimePanelBlueprint:state"]
    titles = by_name["ContainerBlueprint:display_name"]
    assert "zigzag level 3 seed 5: collision" in titles
