"""Pictures of a scene: solids made from its data, a camera, a compiled depth buffer, and a window."""

from dq_space_arm_env.viewing.rendering.renderer import Renderer

__all__ = ["Renderer"]
