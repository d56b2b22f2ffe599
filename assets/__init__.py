"""Data of the package, each file with the script that makes it, and the pictures of README.md."""
