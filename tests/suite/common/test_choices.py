"""What people write for levels, tracks and numbers of trials."""

import pytest

from suite.common.choices import parse_levels, parse_tracks


@pytest.mark.parametrize(
    ("text", "levels"),
    [("3", [3]), ("0,3, 9", [0, 3, 9]), ("7-9,0,8", [7, 8, 9, 0]), ("all", list(range(10)))],
)
def test_levels(text, levels):
    assert parse_levels(text) == levels


@pytest.mark.parametrize("text", ["10", "-1", "3-1", "", "easy", "1,,2", "0-10"])
def test_levels_that_are_none_are_refused_by_name(text):
    with pytest.raises(ValueError, match="--difficulty"):
        parse_levels(text)


def test_tracks():
    assert parse_tracks("all") == ["zigzag", "circular", "ellipse"]
    assert parse_tracks("ellipse,my/course.toml") == ["ellipse", "my/course.toml"]
    with pytest.raises(ValueError, match="Did you mean 'zigzag'"):
        parse_tracks("ellipse,zigzg")
