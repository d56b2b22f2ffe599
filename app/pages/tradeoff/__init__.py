"""The Trade-off page: speed against accuracy."""
