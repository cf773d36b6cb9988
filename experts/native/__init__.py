"""Compiled loops and dense matrix operations of the solver."""
