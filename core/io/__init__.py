"""Files: readers of captures, writers of results, scenes."""
