"""Pictures of a scene: as arrays, or in a window."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.scene import Scene
from dq_space_arm_env.scene.path import shown_target
from dq_space_arm_env.viewing.picture_format import PictureFormat
from dq_space_arm_env.viewing.rendering.camera import camera_of
from dq_space_arm_env.viewing.rendering.drawing import Image, mesh_faces, paint_sky, trail_faces
from dq_space_arm_env.viewing.rendering.rasterizer import Faces, Rasterizer
from dq_space_arm_env.viewing.rendering.solids import Mesh
from dq_space_arm_env.viewing.rendering.spacecraft import SpacecraftModel
from dq_space_arm_env.viewing.rendering.window import Window

Array = NDArray[np.float64]


class Renderer:
    """Draws a scene from a fixed camera.

    The tip has solid axes, red, green and blue for x, y and z; the target has paler ones and a ghost of the
    hand, and the shapes of its body, if the scene gives any. The target is the scene's until another is
    given; if the scene draws it for each episode, the whole spread of its position is in view, and if it
    moves, its path. The payload is at the tip unless another place is given.

    Attributes:
        camera: The camera.
        overlay: Solids in the inertial frame that are drawn too, none at first.
    """

    def __init__(self, scene: Scene, picture: PictureFormat | None = None) -> None:
        picture = picture or PictureFormat()
        width, height, _ = picture
        self._model = SpacecraftModel(scene)
        self.camera = camera_of(self._model.region, scene.base.motion == "planar", picture)
        self.overlay: Sequence[Mesh] = ()
        self._rasterizer = Rasterizer(width, height)
        self._sky = paint_sky(width, height)
        target, body = (each if each is None or each.ndim == 1 else each[0] for each in shown_target(scene))
        assert target is not None
        self.aim_at(target, body)
        self._title = f"DQ Space Arm: {scene.name}"
        self._window: Window | None = None

    def aim_at(
        self, target: ArrayLike, body: ArrayLike | None = None, payload: ArrayLike | None = None
    ) -> None:
        """Move the target and what the tip does not hold, for the pictures that follow.

        Args:
            target: Desired pose of the tip q_{D/I}, shape (8,), real part dimensionless, dual part m.
            body: Pose of the target's body in the inertial frame, where its shapes are drawn, shape (8,),
                same units; None: that of the target.
            payload: Pose of the payload's frame in the inertial frame, shape (8,), same units; None: that of
                the tip, which holds it.
        """
        self._target = np.array(target, dtype=np.float64)
        self._target_body = self._target if body is None else np.array(body, dtype=np.float64)
        self._payload = None if payload is None else np.array(payload, dtype=np.float64)

    # Diverged simulations (infinite, NaN) are not drawn; a warning for each number would not help.
    @np.errstate(over="ignore", invalid="ignore")
    def draw(self, frame_poses: ArrayLike, trail: ArrayLike) -> Image:
        """Draw a state; equal arguments give equal pictures.

        Args:
            frame_poses: Poses of base, joint frames, wrist frame (if any) and tip in the inertial frame, from
                `Kernels.frame_poses`, shape (frames, 8), real part dimensionless, dual part m.
            trail: Past positions of the tip in the inertial frame, oldest first, shape (m, 3), m; m may be 0.

        Returns:
            Picture, shape (height, width, 3), uint8.
        """
        dual_quaternions = _checked("frame_poses", frame_poses, (self._model.frame_count, 8))
        faces = self._faces(dual_quaternions, _checked("trail", trail, (None, 3)))
        image = self._sky.copy()
        self._rasterizer.draw(faces, image)
        return image

    def show(self, frame_poses: ArrayLike, trail: ArrayLike, fps: float) -> None:
        """Show a state, see `draw`, in a window that the first one opens, and wait until the next is due."""
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
        """Faces of the solids and the trail."""
        # After the robot's frames those that `SpacecraftModel` numbers.
        payload = dual_quaternions[-1] if self._payload is None else self._payload
        frames = np.vstack([dual_quaternions, self._target, self._target_body, payload, np.eye(8)[0]])
        mesh = self._model.mesh
        if self.overlay:
            placed = [each.moved(len(frames) - 1, np.eye(3), np.zeros(3)) for each in self.overlay]
            mesh = Mesh.joined([mesh, *placed])
        matrices, origins = poses.to_matrix(frames.T)
        rotations: Array = np.moveaxis(np.array(matrices), 2, 0)
        solids = mesh_faces(mesh, rotations, np.array(origins).T, self.camera)
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
