"""The server: access, routes, sessions and limits."""
