"""Shooting problems: the interface that the solver asks for, and its implementers."""
