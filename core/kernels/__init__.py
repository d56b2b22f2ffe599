"""Compiled code, its compilation options, data layout and thread locks."""
