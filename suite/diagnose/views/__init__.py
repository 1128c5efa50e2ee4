"""Views of real flights: force and torque, each under what was measured of the rest."""
