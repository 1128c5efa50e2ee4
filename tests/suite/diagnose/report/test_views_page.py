"""What the report says of real flights."""

from suite.common.report import html
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.report.page import page
from tracks.common.files import plain


def test_the_page_begins_with_a_sentence_and_a_picture(by_views):
    told = plain(diagnosis_json(by_views))
    text = html(page(by_views, told, None, "mass = 1", {"vehicle.toml"}))
    assert text.index(told["headline"][:40]) < text.index("data:image/png") < text.index("<table")
    assert "What was written" in text and "mass = 1" in text
