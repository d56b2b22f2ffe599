"""Which parts of a model a scene requires."""
