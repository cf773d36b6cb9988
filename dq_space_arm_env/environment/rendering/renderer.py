"""Pictures of a scene: as arrays, or in a window."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.environment.picture_format import PictureFormat, View
from dq_space_arm_env.environment.rendering.camera import camera_around
from dq_space_arm_env.environment.rendering.drawing import Image, mesh_faces, paint_sky, trail_faces
from dq_space_arm_env.environment.rendering.rasterizer import Faces, Rasterizer
from dq_space_arm_env.environment.rendering.spacecraft import SpacecraftModel
from dq_space_arm_env.environment.rendering.window import Window
from dq_space_arm_env.scene import Scene

Array = NDArray[np.float64]

_DEFAULT_VIEW = View(azimuth=190.0, elevation=-22.0)
# A planar scene is seen from straight above, x to the right and y up.
_PLANAR_VIEW = View(azimuth=90.0, elevation=-90.0)


class Renderer:
    """Draws a scene from a fixed camera.

    The tip has solid axes, red, green and blue for x, y and z; the target has paler ones and the likeness of
    a hand. The target is the scene's until another is given; where the scene draws it for each episode, the
    whole spread of its position is in view.

    Attributes:
        camera: The camera.
    """

    def __init__(self, scene: Scene, picture: PictureFormat | None = None) -> None:
        """Build the scene's solids and place the camera.

        Args:
            scene: A validated scene.
            picture: Size of the pictures and from where to look; by default 640 by 480 pixels, with start,
                target and what lies between in view.
        """
        width, height, view = picture or PictureFormat()
        default = _PLANAR_VIEW if scene.base.motion == "planar" else _DEFAULT_VIEW
        given = {key: value for key, value in view._asdict().items() if value is not None}
        self._model = SpacecraftModel(scene)
        self.camera = camera_around(*self._model.region, default._replace(**given), width, height)
        self._rasterizer = Rasterizer(width, height)
        self._sky = paint_sky(width, height)
        self._target = np.array(scene.target.pose.dual_quaternion)
        self._title = f"DQ Space Arm: {scene.name}"
        self._window: Window | None = None

    def aim_at(self, target: ArrayLike) -> None:
        """Move the target.

        Args:
            target: Its pose in the inertial frame, shape (8,), real part dimensionless, dual part m.
        """
        self._target = np.array(target, dtype=np.float64)

    # What has blown up (infinite, NaN) is not drawn; nobody needs a warning for each of its numbers.
    @np.errstate(over="ignore", invalid="ignore")
    def draw(self, frame_poses: ArrayLike, trail: ArrayLike) -> Image:
        """Draw a state; the same arguments give the same picture.

        Args:
            frame_poses: Poses of base, joint frames, wrist frame (if any) and tip in the inertial frame, from
                `Kernels.frame_poses`, shape (frames, 8), real part dimensionless, dual part m.
            trail: Past positions of the tip in the inertial frame, oldest first, shape (m, 3), m; m may be 0.

        Returns:
            Picture, red, green, blue, shape (height, width, 3), uint8.

        Raises:
            ValueError: If a shape does not fit.
        """
        dual_quaternions = _checked("frame_poses", frame_poses, (self._model.frame_count, 8))
        faces = self._faces(dual_quaternions, _checked("trail", trail, (None, 3)))
        image = self._sky.copy()
        self._rasterizer.draw(faces, image)
        return image

    def show(self, frame_poses: ArrayLike, trail: ArrayLike, fps: float) -> None:
        """Show a state in a window, which opens with the first one, and wait until it is time for the next.

        Args:
            frame_poses: As for `draw`, shape (frames, 8), real part dimensionless, dual part m.
            trail: As for `draw`, shape (m, 3), m.
            fps: Pictures per second, 1/s.

        Raises:
            ValueError: If a shape does not fit.
            DependencyNotInstalled: If pygame is not installed.
            Error: If there is no display (`gymnasium.error.Error`).
        """
        if self._window is None:
            self._window = Window(self._title, self.camera.width, self.camera.height)
        if self._window.is_open:
            self._window.show(self.draw(frame_poses, trail), fps)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _faces(self, dual_quaternions: Array, trail: Array) -> Faces:
        """All that may be seen."""
        # The frame after the robot's is the target's.
        matrices, origins = poses.to_matrix(np.vstack([dual_quaternions, self._target]).T)
        rotations: Array = np.moveaxis(np.array(matrices), 2, 0)
        solids = mesh_faces(self._model.mesh, rotations, np.array(origins).T, self.camera)
        ribbon = trail_faces(trail, self.camera)
        return Faces(
            np.concatenate([solids.corners, ribbon.corners]),
            np.concatenate([solids.colors, ribbon.colors]),
            np.concatenate([solids.sieved, ribbon.sieved]),
        )


def _checked(name: str, value: ArrayLike, shape: tuple[int | None, int]) -> Array:
    """The value as an array of the given shape; None stands for any length."""
    array = np.asarray(value, dtype=np.float64)
    rows, columns = shape
    if array.ndim != 2 or array.shape[1] != columns or rows not in (None, array.shape[0]):
        wanted = "m" if rows is None else rows
        raise ValueError(f"{name}: shape {array.shape}, should be ({wanted}, {columns})")
    return array
