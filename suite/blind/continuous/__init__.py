"""A separate simulator for blind cases, in continuous time, without code of the fitted model."""
