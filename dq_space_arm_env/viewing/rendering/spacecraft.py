"""A scene as solids: spacecraft, arm, payload and target, and the region that they reach.

A body with shapes of its own is drawn by these alone. For others a scene gives masses and frames: base,
payload and links at the end of a branch are drawn as the homogeneous boxes of their inertia; other links join
the origins of neighboring frames, in proportions taken from the length of the arm.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.kinematics import frame_poses
from dq_space_arm_env.scene import Scene, StateLayout
from dq_space_arm_env.scene.bodies import freedoms
from dq_space_arm_env.scene.constraint_rows import sides
from dq_space_arm_env.scene.constraints import JointLimits
from dq_space_arm_env.scene.path import shown_target
from dq_space_arm_env.scene.shapes import COLORS, Shape
from dq_space_arm_env.viewing.payload_places import leaves_tip
from dq_space_arm_env.viewing.rendering.body_shapes import balls_around, corners_of, shape_meshes
from dq_space_arm_env.viewing.rendering.solids import Mesh, ball, box, crumpled_box, cylinder, lathe

Array = NDArray[np.float64]

FOIL, METAL, DARK_METAL, RADIATOR, CELLS, LINK, JOINT, GRASPED = (
    COLORS[name] for name in ("foil", "metal", "dark_metal", "radiator", "cells", "white", "slate", "teal")
)
LIKENESS = (0.80, 0.88, 1.0)
AXIS_COLORS = ((1.0, 0.24, 0.22), (0.26, 0.88, 0.34), (0.26, 0.52, 1.0))

_TARGET_POSES = 16  # of a target that moves, kept in view
_THINNEST = 0.05  # of the longest edge: even a flat body is drawn with some thickness
_LIGHTEST = 40.0  # kg/m^3, of a box without a shape of its own


def equivalent_box(mass: float, inertia: ArrayLike) -> tuple[Array, Array]:
    """Homogeneous box of an inertia, I_x = m (b^2 + c^2) / 12 etc.: edge lengths, m, and axes as columns.

    It is smaller where it would be lighter than foam: many files' inertias are guesses.
    """
    matrix = np.asarray(inertia, dtype=np.float64)
    if np.count_nonzero(matrix - np.diag(np.diag(matrix))) == 0:
        moments, axes = np.diag(matrix), np.eye(3)
    else:
        moments, axes = np.linalg.eigh(matrix)
    edges = np.sqrt(np.maximum(6.0 / mass * (moments.sum() - 2.0 * moments), 0.0))
    edges = np.maximum(edges, _THINNEST * edges.max())
    return edges * min(1.0, np.cbrt(mass / edges.prod() / _LIGHTEST)), axes


def frames_before(scene: Scene) -> tuple[list[int], Array]:
    """Find where the frames of `Kernels.frame_poses` are placed: joints, other tips, wrist (if any), tip.

    Args:
        scene: A scene.

    Returns:
        Number of the frame that each is placed in, and its origin there with the joints at zero, shape
        (frames - 1, 3), m.
    """
    before, offsets = [*scene.parent_bodies], [link.joint.position for link in scene.links]
    for tip in scene.other_tips:
        before.append(scene.body_named(tip.link))
        offsets.append(tip.frame.position)
    last = scene.tip_body
    if scene.wrist is not None:
        before.append(last)
        offsets.append(scene.wrist.frame.position)
        last = len(before)
    return [*before, last], np.array([*offsets, scene.tip.position])


class SpacecraftModel:
    """The solids of a scene.

    Frames are numbered as in `Kernels.frame_poses`: base, joints, wrist (if any), tip. The four numbers
    after those stand for the target, which is where the tip should be, for the target's body, for the
    payload, whose frame is that of the tip that holds it, and for the inertial frame.

    Attributes:
        scene: The scene.
        frame_count: Number of frames of the robot.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._before, self._offsets = frames_before(scene)
        # Frames of the tips, the main one last.
        count = 1 + len(scene.links)
        self._tips = [*range(count, count + len(scene.other_tips)), len(self._before)]
        self.frame_count = len(self._offsets) + 1
        self._body_size, self._body_axes = equivalent_box(scene.base.mass, scene.base.inertia)
        if scene.base.geometry:
            self._body_size, self._body_axes = np.ptp(corners_of(scene.base.geometry), axis=0), np.eye(3)
        lengths = np.linalg.norm(self._offsets, axis=1)
        # Without links or wrist the tip is part of the base.
        self._arm_length = float(lengths[self._way_to_tip()[1:]].sum())
        self._thickness = max(0.025 * self._arm_length, 0.03 * float(self._body_size.mean()))

    def _way_to_tip(self) -> list[int]:
        """Offsets that lead from the base to the tip, by their numbers."""
        way = [self.frame_count - 2]
        while before := self._before[way[0]]:
            way.insert(0, before - 1)
        return way

    @cached_property
    def mesh(self) -> Mesh:
        """All solids; the frames after the robot's are those of target, target's body and payload."""
        hand = list(self._hand(self._tips[-1])) if self._has_hand(self._tips[-1]) else []
        others = [part for tip in self._tips[:-1] if self._has_hand(tip) for part in self._hand(tip)]
        # The ghost of the hand stands to the target as the hand to the tip.
        from_tip = np.array(self.scene.tip.rotation_matrix)
        likeness = [
            part.moved(self.frame_count, from_tip.T, -from_tip.T @ self._offsets[-1]).likeness(LIKENESS)
            for part in hand
        ]
        body = shape_meshes(self.frame_count + 1, self.scene.target.geometry, METAL)
        parts = [*self._base(), *self._arm(), *hand, *others, *self._payloads(), *self._axes()]
        parts += [*likeness, *body]
        return Mesh.joined(parts)

    @cached_property
    def axis_length(self) -> float:
        """Length of the drawn axes of tip and target, m; without an arm they must reach out of the body."""
        return 8.5 * self._thickness if self._arm_length else 0.8 * float(self._body_size.max())

    @property
    def region(self) -> tuple[Array, Array]:
        """Balls around start, target, and the arm between: centers (n, 3) and radii (n,), m."""
        start, spread = self.scene.initial_state, self.scene.spread
        tree = KinematicTree.from_scene(self.scene)
        layout = StateLayout.of(self.scene)
        joints = tree.coordinates(layout.initial_state[layout.state.joint_angles].tolist())
        poses_at_start = frame_poses(tree, start.base_pose.dual_quaternion, joints, start.wrist_angles)
        frames = np.array([poses.position(pose) for pose in poses_at_start], dtype=np.float64)
        rotation = np.array(start.base_pose.rotation_matrix)
        wing = rotation @ (self._body_axes[:, self._wing_axes[0]] * self._wing_tip[self._wing_axes[0]])
        shoulder = frames[min(1, len(frames) - 1)]
        # Less than the arm's reach: it works between start and target, and is seen better from near.
        reach = self._arm_length + sum(self._masts) + self._overhang()
        target = 1.2 * self.axis_length + math.sqrt(3.0) * spread.target_position
        drawn = self._thickness + spread.base_position
        levers = spread.base_rotation * np.linalg.norm(frames - frames[0], axis=1)
        body = [
            (frames[0], 0.75 * float(np.linalg.norm(self._body_size))),
            (frames[0] + wing, 0.3 * float(self._body_size.max())),
            (frames[0] - wing, 0.3 * float(self._body_size.max())),
        ]
        balls = [
            *(() if self.scene.base.geometry else body),
            (shoulder, 0.6 * reach),
            (frames[-1], 0.15 * reach + self._overhang()),
            *((frames[end], 0.15 * reach) for end in self._branch_ends),
            *zip(frames, drawn + levers, strict=True),
            *((np.array(poses.position(tuple(pose))), target) for pose in self._target_poses[0]),
            *self._shape_balls(poses_at_start),
        ]
        centers, radii = zip(*balls, strict=True)
        return np.array(centers), np.array(radii)

    def _shape_balls(self, starts: Sequence[Sequence[float]]) -> Iterator[tuple[Array, float]]:
        """Balls around given shapes, given the poses of the robot's frames at the start."""
        for shapes, pose in zip(self._geometry, starts, strict=False):
            yield from balls_around(shapes, pose)
        target, spread = self.scene.target, self.scene.spread
        turn, shift = (math.sqrt(3.0) * width for width in (spread.target_rotation, spread.target_position))
        for pose in self._target_poses[1]:
            yield from balls_around(target.geometry, tuple(pose), turn, shift)
        payload = self.scene.payload
        if payload is not None and leaves_tip(self.scene):
            for pose in self._target_poses[0]:
                if payload.geometry:
                    yield from balls_around(payload.geometry, tuple(pose), turn, shift)
                else:
                    yield np.array(poses.position(tuple(pose))), self._overhang() + shift

    @cached_property
    def _target_poses(self) -> tuple[Array, Array]:
        """Poses of the target and of its body, shape (n, 8) each, some of those on their way."""
        target, body = shown_target(self.scene)
        paths = (np.atleast_2d(target), np.atleast_2d(target if body is None else body))
        stages = np.unique(np.linspace(0, len(paths[0]) - 1, _TARGET_POSES).astype(int))
        return paths[0][stages], paths[1][stages]

    @cached_property
    def _wing_axes(self) -> tuple[int, int, int]:
        """Axes of the body for the wings' length, their width, and their normal.

        The wings stretch in the body's x-y plane, sideways of the first joint.
        """
        shoulder = np.abs(self._body_axes.T @ self._offsets[0])
        normal = int(np.abs(self._body_axes[2]).argmax())
        first, second = (axis for axis in range(3) if axis != normal)
        return (first, second, normal) if shoulder[first] < shoulder[second] else (second, first, normal)

    @cached_property
    def _wing_tip(self) -> Array:
        along, across, _ = self._wing_axes
        tip = np.zeros(3)
        tip[along] = 0.5 * self._body_size[along] + 1.5 * self._body_size.mean()
        tip[across] = 0.34 * self._body_size.mean()
        return tip

    def _base(self) -> Iterator[Mesh]:
        if self.scene.base.geometry:
            yield from shape_meshes(0, self.scene.base.geometry, FOIL)
            return
        size, axes = self._body_size, self._body_axes
        yield crumpled_box(0, (0.0, 0.0, 0.0), size, FOIL, axes)
        yield from self._rims()
        yield from self._wing(1.0)
        yield from self._wing(-1.0)
        if self.scene.actuators.base_force is not None:
            yield from self._thrusters()
        for thruster in self.scene.actuators.thrusters or ():
            outward = tuple(-entry for entry in thruster.unit_direction)
            yield self._nozzle(thruster.position, outward)

    def _rims(self) -> Iterator[Mesh]:
        """Decks at the two ends of the body, and rails along the edges between them."""
        size, axes, mean = self._body_size, self._body_axes, float(self._body_size.mean())
        along, across, normal = self._wing_axes
        deck = size + 0.025 * mean
        deck[normal] = 0.05 * size[normal]
        plate = 0.84 * size
        plate[normal] = 0.075 * size[normal]
        rail = np.full(3, 0.05 * mean)
        rail[normal] = size[normal]
        for side in (-1.0, 1.0):
            end = axes[:, normal] * side * 0.49 * size[normal]
            yield box(0, end, deck, METAL, axes)
            yield box(0, end, plate, RADIATOR, axes)
            for other in (-1.0, 1.0):
                edge = np.zeros(3)
                edge[[along, across]] = (
                    side * (0.5 * size[along] - 0.013 * mean),
                    other * (0.5 * size[across] - 0.013 * mean),
                )
                yield box(0, axes @ edge, rail, METAL, axes)

    def _wing(self, side: float) -> Iterator[Mesh]:
        """A boom and three panels of solar cells."""
        axes, mean = self._body_axes, float(self._body_size.mean())
        along, across, normal = self._wing_axes
        outward = side * axes[:, along]
        root, width = 0.5 * float(self._body_size[along]), 2.0 * float(self._wing_tip[across])
        length = float(self._wing_tip[along]) - root
        yield cylinder(0, outward * root * 0.9, outward * (root + 0.2 * length), 0.02 * mean, METAL, 12)
        panel_length = 0.88 * length / 3
        for panel in range(3):
            center = root + 0.12 * length + (panel + 0.5) * panel_length
            size = np.empty(3)
            size[[along, across, normal]] = 0.96 * panel_length, width, 0.02 * mean
            yield box(0, outward * center, size, METAL, axes)
            size[[along, across, normal]] = 0.42 * panel_length, 0.455 * width, 0.026 * mean
            for row in (-1.0, 1.0):
                for column in (-1.0, 1.0):
                    offset = outward * 0.228 * panel_length * row + axes[:, across] * 0.24 * width * column
                    yield box(0, outward * center + offset, size, CELLS, axes, shine=0.7)

    def _thrusters(self) -> Iterator[Mesh]:
        """Nozzles at the edges of the body; for a planar base, in the plane."""
        axes, size = self._body_axes, self._body_size
        along, across, normal = self._wing_axes
        levels = (0.0,) if self.scene.base.motion == "planar" else (-0.38, 0.38)
        for level in levels:
            for first in (-1.0, 1.0):
                for second in (-1.0, 1.0):
                    corner = np.zeros(3)
                    corner[[along, across, normal]] = first * 0.36, second * 0.5, level
                    yield self._nozzle(axes @ (corner * size), second * axes[:, across])

    def _nozzle(self, place: Sequence[float] | Array, outward: Sequence[float] | Array) -> Mesh:
        """The nozzle of a thruster, at a place of the base."""
        bell = [(0.0, 0.0), (0.0, 0.022), (0.03, 0.022), (0.095, 0.05), (0.095, 0.042), (0.05, 0.0)]
        mean, colors = float(self._body_size.mean()), [METAL, METAL, METAL, METAL, DARK_METAL]
        return lathe(
            0, place, outward, [(height * mean, radius * mean) for height, radius in bell], colors, 16
        )

    def radius(self, frame: int) -> float:
        """Radius of the link in a frame, m: the arm tapers toward the tip."""
        return self._thickness * (1.15 - 0.4 * frame / self.frame_count)

    def _arm(self) -> Iterator[Mesh]:
        shapes = self._geometry
        for index, frame in enumerate(self._before):
            if shapes[frame]:
                continue
            end = self._hand_start(index + 1) if index + 1 in self._tips else self._offsets[index]
            radius, color = (self.radius(frame), LINK) if frame else (1.2 * self.radius(frame), METAL)
            if np.linalg.norm(end) > 0.1 * radius:
                yield cylinder(frame, (0.0, 0.0, 0.0), end, radius, color)
        for frame in self._branch_ends:
            link = self.scene.links[frame - 1]
            if not shapes[frame]:
                size, axes = equivalent_box(link.mass, link.inertia)
                yield box(frame, link.center_of_mass, size, LINK, axes)
        for joint, link in enumerate(self.scene.links, start=1):
            if shapes[joint]:
                yield from shape_meshes(joint, shapes[joint], LINK)
            elif link.is_spherical:
                yield ball(joint, (0.0, 0.0, 0.0), 1.5 * self.radius(joint), JOINT)
            elif not link.is_fixed:
                yield from self._joint(joint)
        if self.scene.wrist is not None:
            frame = len(self._before) - 1
            yield ball(frame, (0.0, 0.0, 0.0), 1.5 * self.radius(frame), JOINT)

    @cached_property
    def _masts(self) -> list[float]:
        """Farthest slide of each joint, at the start or by its limits, m."""
        farthest = [max(angle, 0.0) for angle in self.scene.initial_state.joint_angles]
        for limits in (each for each in self.scene.constraints if isinstance(each, JointLimits)):
            for side in sides(self.scene, limits):
                if side.sign > 0 and not side.is_rate:
                    farthest[side.joint] = max(farthest[side.joint], side.bound)
        tree, masts = KinematicTree.from_scene(self.scene), [0.0] * len(self.scene.links)
        moving = zip(freedoms(self.scene.links), tree.links, farthest, strict=True)
        for (index, _), link, most in moving:
            masts[index] = max(link.screw.slide * most, 0.0)
        return masts

    @property
    def _geometry(self) -> list[tuple[Shape, ...]]:
        """Given shapes of what is fixed in each frame but the tip's; a wrist has none."""
        own = [self.scene.base.geometry, *(link.geometry for link in self.scene.links)]
        own += [()] * len(self.scene.other_tips)
        return own if self.scene.wrist is None else [*own, ()]

    @property
    def _branch_ends(self) -> list[int]:
        """Frames of links that carry nothing."""
        return [frame for frame in range(1, len(self.scene.links) + 1) if frame not in self._before]

    def _has_hand(self, tip: int) -> bool:
        """Whether a hand is drawn: as part of the body before a tip, if that has no shapes of its own."""
        return not self._geometry[self._before[tip - 1]]

    def _joint(self, frame: int) -> Iterator[Mesh]:
        """A beveled housing along the joint's z axis, and a mast as long as the joint slides."""
        if mast := self._masts[frame - 1]:
            yield cylinder(frame, (0.0, 0.0, 0.0), (0.0, 0.0, -mast), 0.7 * self.radius(frame), METAL)
        radius, half = 1.5 * self.radius(frame), 1.6 * self.radius(frame)
        bevel = 0.2 * radius
        profile = [(-half, 0.0), (-half, radius - bevel), (bevel - half, radius), (half - bevel, radius)]
        profile += [(half, radius - bevel), (half, 0.0)]
        yield lathe(frame, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), profile, JOINT)

    @property
    def _hand_length(self) -> float:
        return 5.0 * self._thickness

    def _approach(self, tip: int) -> Array:
        """Unit direction of a tip's hand, in the frame before: that of the last link."""
        direction = self._offsets[tip - 1]
        if not direction.any() and self.scene.wrist is not None and tip == self._tips[-1]:
            direction = np.array(self.scene.wrist.frame.rotation_matrix).T @ self._offsets[-2]
        if not direction.any():
            direction = np.array([0.0, 0.0, 1.0])
        return np.asarray(direction / np.linalg.norm(direction))

    def _hand_start(self, tip: int) -> Array:
        """Start of a tip's hand, in the frame before, m: it ends at the tip if there is room."""
        room = float(np.linalg.norm(self._offsets[tip - 1])) - self._hand_length
        return self._approach(tip) * max(0.0, room)

    def _overhang(self) -> float:
        """Reach of hand and payload beyond the tip, m."""
        overhang = max(0.0, self._hand_length - float(np.linalg.norm(self._offsets[-1])))
        payload = self.scene.payload
        if payload is not None and payload.geometry:
            overhang = max(overhang, float(np.linalg.norm(corners_of(payload.geometry), axis=1).max()))
        elif payload is not None:
            size, _ = equivalent_box(payload.mass, payload.inertia)
            overhang = max(overhang, float(np.linalg.norm(payload.center_of_mass) + 0.5 * size.max()))
        return overhang

    def _hand(self, tip: int) -> Iterator[Mesh]:
        """A palm and two fingers."""
        frame, start = self._before[tip - 1], self._hand_start(tip)
        radius, length, approach = 0.8 * self._thickness, self._hand_length, self._approach(tip)
        opening = np.cross(approach, np.eye(3)[np.abs(approach).argmin()])
        opening /= np.linalg.norm(opening)
        axes = np.column_stack([opening, np.cross(approach, opening), approach])
        profile = [(0.0, 0.0), (0.0, radius), (0.3, 1.3 * radius), (0.4, 1.3 * radius), (0.4, 0.0)]
        scaled = [(height * length, ring) for height, ring in profile]
        yield lathe(frame, start, approach, scaled, JOINT)
        for side in (-1.0, 1.0):
            center = start + 0.68 * length * approach + side * radius * opening
            yield box(frame, center, (0.5 * radius, 1.2 * radius, 0.64 * length), DARK_METAL, axes)

    def _payloads(self) -> Iterator[Mesh]:
        held = [(self.frame_count + 2, self.scene.payload)]
        held += [(tip, other.payload) for tip, other in zip(self._tips, self.scene.other_tips, strict=False)]
        for frame, payload in held:
            if payload is not None and payload.geometry:
                yield from shape_meshes(frame, payload.geometry, GRASPED)
            elif payload is not None:
                size, axes = equivalent_box(payload.mass, payload.inertia)
                yield box(frame, payload.center_of_mass, size, GRASPED, axes)

    def _axes(self) -> Iterator[Mesh]:
        """Axes of the tips, and thicker and lighter ones at the target."""
        thickness, length = self._thickness, self.axis_length
        for tip in self._tips:
            yield from _arrows(tip, length, 0.26 * thickness, 0.0)
        yield from _arrows(self.frame_count, length, 0.42 * thickness, 0.5)
        for other in self.scene.other_tips:
            frame = self.frame_count + (1 if other.relative_to == "target" else 3)
            rotation, place = np.array(other.goal.rotation_matrix), np.array(other.goal.position)
            for arrow in _arrows(0, length, 0.42 * thickness, 0.5):
                yield arrow.moved(frame, rotation, place)


def _arrows(frame: int, length: float, radius: float, lightness: float) -> Iterator[Mesh]:
    """Arrows along the axes of a frame, x red, y green, z blue, mixed with white."""
    head = length - 6.0 * radius
    profile = [(0.0, 0.0), (0.0, radius), (head, radius), (head, 2.3 * radius), (length, 0.0)]
    for direction, color in zip(np.eye(3), AXIS_COLORS, strict=True):
        red, green, blue = (part + lightness * (1.0 - part) for part in color)
        yield lathe(frame, np.zeros(3), direction, profile, (red, green, blue), 12)
