"""Files in, a vehicle file out; what cannot be left is refused."""

import pytest

from suite.common.console import Console
from suite.diagnose.identify.run import PARTS, identify_files


def test_a_part_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ValueError, match=f"allowed: {', '.join(PARTS)}"):
        identify_files([tmp_path], "reference", tmp_path / "v.toml", ["wings"], Console())
