"""The Panel app: everything that needs a screen. It uses `core` by its documented names only."""
