"""The verbs solve, demonstrations and report."""
