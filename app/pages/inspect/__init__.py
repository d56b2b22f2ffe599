"""The Inspect page: one pixel, region or capture in detail."""
