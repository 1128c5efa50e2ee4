"""Policies: their observation, networks, file formats, and the policies that the suite ships."""
