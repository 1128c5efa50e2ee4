"""Plans that tell two effects apart."""

from eval.effects import EFFECTS
from suite.diagnose.plans.plan import SEPARATIONS, plan_for, separations_of


def test_plans_name_catalogue_effects_and_end_in_flights():
    for entry in SEPARATIONS:
        assert set(entry.pair) <= set(EFFECTS) and entry.pair[0] != entry.pair[1]
        assert entry.separating and entry.blurred and entry.words
    assert separations_of(["rotor_drag", "linear_drag"])[0].pair == ("linear_drag", "rotor_drag")
    (wind,) = separations_of(["frame_tilt", "constant_wind + linear_drag"])
    assert wind.pair == ("constant_wind", "frame_tilt") and "two headings" in wind.words
    assert plan_for(["gusts", "inflow"]), "an unknown pair gets the flights that excite most"
