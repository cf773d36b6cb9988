"""Import from URDF, export to URDF and MJCF, dynamics in CasADi, PyTorch, JAX and Pinocchio."""
