"""Mapping files: the shipped ones can be read, others are refused by key."""

from pathlib import Path

import pytest

from eval.importers.mapping_file import UNITS, WIDTHS, read_map, shipped_maps


def test_every_shipped_mapping_is_read_by_its_name():
    assert {"nanobench", "crazypad", "crazyswarm2", "crazyflie"} <= set(shipped_maps())
    for name in shipped_maps():
        told = read_map(Path(name))
        assert told.motor_side is not None
        for signal, alternatives in told.columns.items():
            assert signal in UNITS
            for column in alternatives:
                assert len(column.factor) == WIDTHS[signal]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('[pwm]\ncolumns = ["a", "b", "c"]', "pwm.columns .* 4 column names"),
        ('[pwm]\ncolumn = "a"\nmixer = "x"', "pwm.mixer is 'x', allowed is 'crazyflie'"),
        ('[acc]\ncolumn = "a"\naxes = "ned"', "acc.axes is 'ned', allowed is 'body' or 'world'"),
        ('[pos]\ncolumn = "a"\nsource = "gps"', "pos.source is 'gps', allowed is 'mocap'"),
        ('[pos]\ncolumn = "a"\nscale = -1.0', "pos.scale is -1.0"),
        ("[frames]\nmotors = [[1, 1]]", "frames.motors"),
        ("[frames]\nmotors = [[1, 1], [0, 0], [1, -1], [-1, -1]]", "motors is .*off the middle"),
        ('[about]\nfile = "{log}.yaml"', "about.file is '{log}.yaml'.*{stem} and {number} alone"),
        ('[about]\nfile = "{stem.yaml"', "about.file is .*{stem} and {number} alone"),
        ('keep = ["flight"]', "keep is .*not a flight log's own, as 'flight' is"),
        ('keep = ["other", "motor_1"]', "keep is .*not a flight log's own, as 'motor_1' is"),
        ('optional = "maybe"', "optional is 'maybe', allowed is 'no' or 'yes'"),
    ],
)
def test_a_wrong_mapping_is_refused_by_key(tmp_path, text, reason):
    path = tmp_path / "map.toml"
    path.write_text(text + "\n")
    with pytest.raises(ValueError, match=reason):
        read_map(path)


def test_an_unknown_name_is_refused_with_the_names_there_are():
    with pytest.raises(ValueError, match="nanobench"):
        read_map(Path("nanobank"))
