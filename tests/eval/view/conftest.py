"""A flight that finished and one that collided, recorded once for all tests."""

import pytest

from eval.view.recording import write_recording
from tests.support.flights import rollout
from tests.support.recordings import columns


@pytest.fixture(scope="session")
def recorded(tmp_path_factory):
    """A recording of two flights, and its columns."""
    path = tmp_path_factory.mktemp("rrd") / "two.rrd"
    crash = rollout("collision", 1.5, False)
    assert write_recording(path, [rollout(), crash]) == path
    assert [p.name for p in path.parent.iterdir()] == ["two.rrd"]
    return path, columns(path)
