"""A diagnosis as JSON, HTML and recording."""
