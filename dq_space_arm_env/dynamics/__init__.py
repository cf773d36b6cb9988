"""Equations of motion over plain scalars: the paper's Newton-Euler system, and minimal coordinates."""
