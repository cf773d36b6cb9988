"""Kernels: the machine code of a scene behind ordinary functions on arrays."""

from dq_space_arm_env.kernels.kernels import Kernels, compile_scene

__all__ = ["Kernels", "compile_scene"]
