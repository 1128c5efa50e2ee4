"""Numbers, their fit, intervals and chance."""
