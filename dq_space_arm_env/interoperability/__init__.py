"""Ways in and out: scenes from URDF, scenes to URDF and MJCF, and their dynamics in CasADi and Pinocchio.

Nothing else in the package imports this one; each module brings in what it needs when it is used.
"""
