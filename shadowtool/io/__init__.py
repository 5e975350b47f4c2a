"""Files: the only layer that knows paths and formats."""
