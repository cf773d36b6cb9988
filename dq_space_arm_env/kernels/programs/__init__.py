"""Programs of a scene: steps, derivatives, costs, environments, the paper's formulation."""
