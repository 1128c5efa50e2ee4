"""A policy leaves the house: exported, measured, and said what it is."""
