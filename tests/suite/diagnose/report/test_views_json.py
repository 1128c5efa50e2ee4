"""What JSON and page hold of real flights, which are diagnosed by force and torque."""

from suite.common.report import html
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.report.page import page
from suite.diagnose.report.summary import answer
from tracks.common.files import plain


def test_each_view_names_its_own_effect_with_its_share(by_views):
    found = plain(diagnosis_json(by_views))
    effects = {effect["name"]: effect for effect in found["effects"]}
    assert effects["linear_drag"]["view"] == "force"
    assert 0.0 < effects["linear_drag"]["gap_removed"] <= 1.0
    span = effects["linear_drag"]["parameters"]["coefficient"]["ci95"][0]
    assert span[0] < 0.4 < span[1]
    assert all(effect["view"] == "torque" for n, effect in effects.items() if n != "linear_drag")


def test_the_json_has_every_axis_and_the_page_its_headline_first(by_views):
    found = plain(diagnosis_json(by_views))
    assert set(found["gap"]["channels"]["force"]) == {"x", "y", "z"}
    main = found["gap"]["channels"][by_views.main.source.name]
    whole = sum(axis["before"] ** 2 for axis in main.values()) ** 0.5
    assert abs(found["gap"]["before"] - whole) < 1e-9 * whole
    assert found["headline"].startswith(answer(found)) and "linear_drag" in answer(found)
    text = html(page(by_views, found, "mass = 1", {"vehicle.toml"}))
    assert text.index(found["headline"][:40]) < text.index("data:image/png") < text.index("<table")
    assert "What was written" in text and "mass = 1" in text and "black box" in text
