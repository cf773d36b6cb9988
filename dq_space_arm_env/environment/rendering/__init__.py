"""Pictures of a scene: solids made from its data, a camera, a depth buffer in NumPy, and a window."""

from dq_space_arm_env.environment.rendering.renderer import Renderer

__all__ = ["Renderer"]
