"""Captures larger than memory: tiles and windows."""
