"""Checks of a policy for common errors of unit, scale, sign, frame and memory."""
