"""Files in, a vehicle file out; what cannot be left is refused."""

import pytest

from eval.quadrotor.vehicle_file import save_vehicle
from suite.common.console import Console
from suite.diagnose.identify.run import PARTS, identify_files
from tests.support.vehicles import with_effects


def test_a_part_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ValueError, match=f"allowed: {', '.join(PARTS)}"):
        identify_files([tmp_path], "reference", tmp_path / "v.toml", ["wings"], Console())


def test_a_file_with_a_load_on_a_line_is_refused_before_the_flights_are_read(tmp_path):
    file = tmp_path / "loaded.toml"
    save_vehicle(with_effects(slung_load=(0.05, 0.5)), file)
    with pytest.raises(ValueError, match="plain: effects.slung_load has a motion of its own"):
        identify_files([tmp_path / "none"], str(file), tmp_path / "v.toml", [], Console())
