"""The curve of a run: rows for TensorBoard, numbered by iteration."""

import sys
import types

import pytest

from suite.common import curve


class Writer:
    """Keeps what TensorBoard would be shown."""

    made = []

    def __init__(self, folder, purge_step):
        self.folder, self.first, self.rows = folder, purge_step, []
        Writer.made.append(self)

    def add_scalar(self, name, value, step):
        self.rows.append((name, value, step))

    def flush(self):
        pass


def test_numbers_reach_tensorboard_from_the_first_step_or_the_missing_package_is_named(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(Writer, "made", [])
    package = types.SimpleNamespace(SummaryWriter=Writer)
    monkeypatch.setitem(sys.modules, "tensorboardX", package)
    mirror = curve.tensorboard(tmp_path)
    mirror([])
    mirror([{"iteration": 7, "loss": 0.5, "note": "words"}])
    mirror([{"iteration": 8, "loss": 0.25}])
    (writer,) = Writer.made
    assert (writer.folder, writer.first) == (str(tmp_path / "tensorboard"), 7)
    assert writer.rows == [("loss", 0.5, 7), ("loss", 0.25, 8)]
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(ValueError, match=r"pip install 'diffracing-suite\[tensorboard\]'"):
        curve.tensorboard(tmp_path)
