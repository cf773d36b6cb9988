"""Agents that follow the exact gradient of their episodes' cost, by reverse mode through the simulation."""
