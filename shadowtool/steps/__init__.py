"""The six steps as functions: each reads and writes files, and can be called from Python."""
