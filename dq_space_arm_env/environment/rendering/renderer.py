"""Pictures of a scene: as arrays, or in a window."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.environment.rendering.camera import camera_around
from dq_space_arm_env.environment.rendering.drawing import (
    OVERSAMPLING,
    Image,
    mean_of_subpixels,
    mesh_faces,
    paint_background,
    paint_faces,
    trail_faces,
)
from dq_space_arm_env.environment.rendering.label import Label
from dq_space_arm_env.environment.rendering.spacecraft import SpacecraftModel
from dq_space_arm_env.environment.rendering.window import Window
from dq_space_arm_env.scene import Scene

Array = NDArray[np.float64]

_AZIMUTH, _ELEVATION = math.radians(25.0), math.radians(25.0)
# A planar scene is seen from straight above, x to the right and y up.
_PLANAR_AZIMUTH, _PLANAR_ELEVATION = math.radians(-90.0), math.radians(90.0)


class Renderer:
    """Draws a scene from a fixed camera that has the whole reach of the arm and the target in view.

    The target is the scene's until another is given; where the scene draws it for each episode, the whole
    spread of its position is in view.

    Attributes:
        camera: The camera.
    """

    def __init__(self, scene: Scene, width: int = 640, height: int = 480) -> None:
        """Build the scene's solids and place the camera.

        Args:
            scene: A validated scene.
            width: Width of the pictures, pixels.
            height: Height of the pictures, pixels.

        Raises:
            ValueError: If width or height is not a positive integer.
            DependencyNotInstalled: If pygame is not installed.
        """
        for name, value in (("width", width), ("height", height)):
            if not isinstance(value, int) or value < 1:
                raise ValueError(f"{name}: {value!r} is no number of pixels, it must be a positive integer")
        planar = scene.base.motion == "planar"
        azimuth, elevation = (_PLANAR_AZIMUTH, _PLANAR_ELEVATION) if planar else (_AZIMUTH, _ELEVATION)
        self._model = SpacecraftModel(scene)
        centers, radii = self._model.region
        self.camera = camera_around(centers, radii, azimuth, elevation, width, height)
        self._fine_camera = self.camera.scaled(OVERSAMPLING)
        self._background = paint_background(self._fine_camera.width, self._fine_camera.height)
        self._empty_image = mean_of_subpixels(self._background)
        self._target = np.array(scene.target.pose.dual_quaternion)
        self._label = self._label_of(self._target)
        self._title = f"DQ Space Arm: {scene.name}"
        self._window: Window | None = None

    def _label_of(self, target: Array) -> Label:
        """The word next to the target's axes."""
        rotation, position = poses.to_matrix(target)
        ends = self._model.axis_length * np.array(rotation).T + np.array(position)
        return Label("target", self.camera, np.array(position), ends)

    def aim_at(self, target: ArrayLike) -> None:
        """Move the target.

        Args:
            target: Its pose in the inertial frame, shape (8,), real part dimensionless, dual part m.
        """
        pose = np.array(target, dtype=np.float64)
        if not np.array_equal(pose, self._target):
            self._target, self._label = pose, self._label_of(pose)

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
        corners, colors = self._faces(dual_quaternions, _checked("trail", trail, (None, 3)))
        image = self._empty_image.copy()
        paint_faces(image, self._background, corners, colors)
        self._label.draw(image)
        return image

    def show(self, frame_poses: ArrayLike, trail: ArrayLike, fps: float) -> None:
        """Show a state in a window, which opens with the first one, and wait until it is time for the next.

        Args:
            frame_poses: As for `draw`, shape (frames, 8), real part dimensionless, dual part m.
            trail: As for `draw`, shape (m, 3), m.
            fps: Pictures per second, 1/s.

        Raises:
            ValueError: If a shape does not fit.
            Error: If there is no display (`gymnasium.error.Error`).
        """
        if self._window is None:
            self._window = Window(self._title, self.camera.width, self.camera.height)
        self._window.show(self.draw(frame_poses, trail), fps)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    # What has blown up (infinite, NaN) is not drawn; nobody needs a warning for each of its numbers.
    @np.errstate(over="ignore", invalid="ignore")
    def _faces(self, dual_quaternions: Array, trail: Array) -> tuple[Array, Array]:
        """Corners and colors of all that may be seen, in subpixels."""
        # The frame after the robot's is the target's.
        matrices, origins = poses.to_matrix(np.vstack([dual_quaternions, self._target]).T)
        rotations: Array = np.moveaxis(np.array(matrices), 2, 0)
        positions = np.array(origins).T
        solids = mesh_faces(self._model.mesh, rotations, positions, self._fine_camera)
        ribbon = trail_faces(trail, self._fine_camera)
        return np.concatenate([solids[0], ribbon[0]]), np.concatenate([solids[1], ribbon[1]])


def _checked(name: str, value: ArrayLike, shape: tuple[int | None, int]) -> Array:
    """The value as an array of the given shape; None stands for any length."""
    array = np.asarray(value, dtype=np.float64)
    rows, columns = shape
    if array.ndim != 2 or array.shape[1] != columns or rows not in (None, array.shape[0]):
        wanted = "m" if rows is None else rows
        raise ValueError(f"{name}: shape {array.shape}, should be ({wanted}, {columns})")
    return array
