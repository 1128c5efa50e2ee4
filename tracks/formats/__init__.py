"""A scene in other forms: track files, meshes, MuJoCo."""
