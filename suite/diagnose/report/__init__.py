"""Presents a diagnosis as JSON, as a web page, and as a recording for rerun."""
