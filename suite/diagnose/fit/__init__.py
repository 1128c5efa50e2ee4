"""The model, its normal equations, and the search for what is missing."""
