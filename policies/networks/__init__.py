"""The neural networks (policy and Delta Action Model), their layers and parameters."""
