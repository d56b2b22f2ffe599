"""What `python -m tests.attack` tries, one module for each kind of attacker."""
