"""Geometry on a scene: depth, clearance, the attractive field, crossings."""
