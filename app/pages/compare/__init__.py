"""The Compare page: methods side by side."""
