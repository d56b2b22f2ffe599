"""Attacks of `python -m tests.attack`, one module for each kind of attacker."""
