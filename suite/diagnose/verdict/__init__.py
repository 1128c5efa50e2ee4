"""What the verdict is based on: gaps, sizes of effects, structure in the residual, actuators."""
