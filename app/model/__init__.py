"""State and results, without widgets."""
