"""Compiled code, and how it is compiled, laid out and entered."""
