"""Import from URDF, export to URDF and MJCF, dynamics in CasADi and Pinocchio."""
