"""Recordings for rerun, read back."""

import numpy as np
import rerun.chunk


def columns(path, store=None):
    """Every component of a recording: {(entity, component): (times or None, values)}."""
    reader = rerun.chunk.RrdReader(path)
    found = {}
    for chunk in reader.stream(store=store).to_chunks():
        batch = chunk.to_record_batch()
        times = None
        if "time" in chunk.timeline_names:
            times = batch.column("time").to_numpy().astype(np.int64)
        for name in batch.schema.names:
            if name not in (*chunk.timeline_names, "rerun.controls.RowId"):
                assert (chunk.entity_path, name) not in found
                found[chunk.entity_path, name] = (times, batch.column(name).to_pylist())
    return found
