"""The search for the effects that explain flights, and for changes since reference flights."""
