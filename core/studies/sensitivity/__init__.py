"""The range of each setting within which a method can be trusted."""
