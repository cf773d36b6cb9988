"""Control-limited differential dynamic programming."""
