"""Sources of evidence: ways to compare flights with the model, and the steps of a diagnosis."""
