"""The Explore page: one method in detail."""
