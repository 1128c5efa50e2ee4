"""Finding where flights and simulation disagree, and which physical effect is missing."""
