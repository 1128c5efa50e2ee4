"""The verdict: gaps, relevance, structure in the residual, actuators."""
