"""The parts of an experiment: training several settings from several seeds, judging, comparing."""
