"""Geometry of a scene: depth images, distances to obstacles, the field of a gate, crossings."""
