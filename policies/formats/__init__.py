"""Policies as files: our checkpoints, ONNX, torch."""
