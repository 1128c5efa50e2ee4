"""An engine of its own for blind cases: continuous time, and no code of the model that fits."""
