"""The server: who is served, what, and how much of it."""
