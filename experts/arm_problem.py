"""A scene as a shooting problem: its kernels, bounds, horizon and start under the names the solver uses."""

from pathlib import Path

import numpy as np

from dq_space_arm_env import Scene, compile_scene, load_scene
from experts.problem import FloatArray, Kernel
from experts.screw_motion import ScrewMotion, screw_motion

SCREW_DURATION = 0.15
"""Share of the horizon that a guess by screw motion gives the tip: the cost asks for haste."""


class ArmProblem:
    """The maneuver of a scene in minimal coordinates, in double precision; implements `ShootingProblem`.

    Attributes:
        scene: The scene.
        kernels: Its compiled functions.
    """

    has_second_order = True
    has_retraction = True

    def __init__(self, scene: Scene | str | Path, integrator: str | None = None) -> None:
        """Take a scene.

        Args:
            scene: A scene, the name of a shipped one, or a path to a YAML file.
            integrator: Name of the integrator; the scene's by default.

        Raises:
            SceneError: If the scene cannot be loaded.
            ValueError: If the integrator is unknown.
        """
        self.scene = in_double_precision(load_scene(scene), integrator)
        self.kernels = compile_scene(self.scene)
        layout = self.kernels.layout
        self.n_states, self.n_tangent, self.n_controls = layout.n_x, layout.n_t, layout.n_u
        self.horizon = self.scene.simulation.steps
        self.time_step = self.scene.simulation.dt
        self.control_lower: FloatArray = -layout.control_limit
        self.control_upper: FloatArray = layout.control_limit
        self.initial_state: FloatArray = layout.initial_state

    def is_success(self, state: FloatArray) -> bool:
        """Tell whether an episode that ends in a state counts as a success.

        Args:
            state: Final state, shape (n_x,), units of `kernels.layout.state`.

        Returns:
            Whether the tip's errors are within the scene's tolerances.
        """
        angle, distance = self.kernels.observation(state, [0.0])[1]
        success = self.scene.success
        return bool(np.degrees(angle) <= success.attitude_error_deg and distance <= success.position_error)

    def screw_motion(self, x0: FloatArray) -> ScrewMotion:
        """Guess the maneuver from a start, from kinematics alone; see `experts.screw_motion`.

        Args:
            x0: State at stage 0, shape (n_x,), units of `kernels.layout.state`.

        Returns:
            The guess.

        Raises:
            ValueError: If x0 has the wrong shape or is not finite.
        """
        return screw_motion(self, x0, duration=SCREW_DURATION * self.horizon * self.time_step)

    def kernel(self, name: str, *, batched: bool = False) -> Kernel:
        """Return one of the kernels that `experts.problem` lists.

        Args:
            name: Name of the kernel.
            batched: Whether it will work on many rows at once: vector code; scalar code otherwise.

        Returns:
            The kernel, compiled or loaded from the cache.
        """
        return self.kernels.kernel(name, lanes=None if batched else 1)


def in_double_precision(scene: Scene, integrator: str | None = None) -> Scene:
    """A scene as the solver takes it: convergence needs the digits, whatever agents simulate in.

    Args:
        scene: The scene.
        integrator: Name of the integrator; the scene's by default.

    Returns:
        The scene with double precision and the integrator.

    Raises:
        ValueError: If the integrator is unknown.
    """
    changes = {"precision": "float64", "integrator": integrator or scene.simulation.integrator}
    return scene.replace(simulation={**scene.simulation.model_dump(), **changes})
