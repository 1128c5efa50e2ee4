"""The curve of a run: rows appended, read once each, and cut back."""

from suite.common import curve


def test_rows_written_twice_by_an_interrupted_save_count_once(tmp_path):
    for first in (0, 1):
        curve.append(tmp_path, [{"iteration": i, "loss": 1.0} for i in range(first, 3)])
    assert [row["iteration"] for row in curve.read(tmp_path)] == [0, 1, 2]


def test_a_line_cut_short_is_left_out_and_a_cut_drops_what_is_computed_again(tmp_path):
    assert curve.read(tmp_path) == [] and curve.cut(tmp_path, 0) is None
    curve.append(tmp_path, [{"iteration": i, "loss": float(i)} for i in range(4)])
    with (tmp_path / curve.CURVE).open("a") as file:
        file.write('{"iteration": 4, "lo')
    assert [row["loss"] for row in curve.read(tmp_path)] == [0.0, 1.0, 2.0, 3.0]
    curve.cut(tmp_path, 2)
    assert [row["iteration"] for row in curve.read(tmp_path)] == [0, 1]
    assert (tmp_path / curve.CURVE).read_text().endswith("\n")
    assert curve.read(tmp_path, curve.WATCHED) == [], "the other curve is another file"
