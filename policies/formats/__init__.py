"""Policies as files: the suite's checkpoints, ONNX, torch and C."""
