"""What all charts share: a figure of so many pixels, and axes without what is no data."""

import struct

from matplotlib.figure import Figure

from suite.common.charts import DPI, png, titled


def test_a_figure_is_a_png_file_of_its_size():
    file = png(Figure(figsize=(2.0, 1.0)))
    assert file.startswith(b"\x89PNG")
    assert struct.unpack(">II", file[16:24]) == (2 * DPI, DPI)


def test_axes_have_a_title_and_no_frame_above_and_right():
    axes = Figure().subplots()
    titled(axes, "Speed")
    assert axes.get_title(loc="left") == "Speed" and axes.get_title() == ""
    shown = {side: spine.get_visible() for side, spine in axes.spines.items()}
    assert shown == {"left": True, "bottom": True, "top": False, "right": False}
    assert axes.get_axisbelow() is True
