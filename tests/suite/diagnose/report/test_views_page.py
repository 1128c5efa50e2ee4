"""What the report says of real flights."""

from suite.common.report import html
from suite.diagnose.report.page import views_page
from suite.diagnose.report.views_json import views_json
from tracks.common.files import plain


def test_the_page_begins_with_a_sentence_and_a_picture(by_views):
    told = plain(views_json(by_views))
    text = html(views_page(by_views, told, "mass = 1"))
    assert text.index(told["headline"][:40]) < text.index("data:image/png") < text.index("<table")
    assert "What was written" in text and "mass = 1" in text
