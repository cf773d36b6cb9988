"""The verbs train, evaluate and compare."""
