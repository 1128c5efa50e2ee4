"""The blind command."""

import json

from suite import cli


def test_the_command_says_which_flights_separate(capsys):
    assert cli.main(["blind", "plan", "--effects", "linear_drag", "rotor_drag", "--json"]) == 0
    flights = json.loads(capsys.readouterr().out)["flights"]
    assert {flight["kind"] for flight in flights} == {"punches", "figure_eight"}
    assert cli.main(["blind", "plan"]) == 2
    assert cli.main(["blind", "score", "--out", "/no/such/set"]) == 2
