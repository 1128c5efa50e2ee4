"""Trials of a policy flown, judged and counted."""
