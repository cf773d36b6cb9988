"""Equations of motion over plain scalars: the paper's system, articulated bodies, the mass matrix."""
