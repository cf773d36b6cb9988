"""The maneuver in the paper's own formulation: 46 states with the tip's pose appended.

A slow reference: 54 numbers represent 21 coordinates and rates, every derivative is 54 wide, and the value
function is rank-deficient. Tests confirm that DDP finds the same maneuver as in minimal coordinates
(`ArmProblem`).
"""

from pathlib import Path

import numpy as np

from dq_space_arm_env import Scene, compile_scene, load_scene
from experts.problems.arm_problem import in_double_precision
from experts.problems.shooting_problem import FloatArray, Kernel, StageParameters


def beyond_the_paper(scene: Scene) -> list[str]:
    """What a scene asks for beyond the paper's cost of one target pose at rest, in words for a sentence."""
    cost = scene.cost
    asked = {
        "errors relative to the tip (cost.pose_error)": cost.pose_error != "paper",
        "a target that moves (target.motion)": scene.target.motion is not None,
        "phases": bool(scene.phases),
        "tips of other arms (other_tips)": bool(scene.other_tips),
        "constraints": bool(scene.constraints),
        "weights of the tip's twist": any(cost.tip_twist) or any(cost.terminal_tip_twist),
    }
    return [words for words, applies in asked.items() if applies]


class PaperProblem:
    """A scene in the paper's formulation, stepped by classical Runge-Kutta; a `ShootingProblem`."""

    terminal_inputs = ()
    has_second_order = False
    has_retraction = False
    has_mixed_cost = False

    def __init__(self, scene: Scene | str | Path = "paper") -> None:
        """Load a scene.

        Args:
            scene: A scene, the name of a shipped one, or a path to a YAML file.

        Raises:
            SceneError: If the scene cannot be loaded.
            ValueError: If it asks for what the paper's cost does not have.
        """
        self.scene = in_double_precision(load_scene(scene))
        if more := beyond_the_paper(self.scene):
            raise ValueError(
                f"scene {self.scene.name!r} has {' and '.join(more)}: the paper's formulation knows only its "
                "own cost of a target at rest"
            )
        self.kernels = compile_scene(self.scene)
        layout = self.kernels.layout
        self.initial_state = self.from_minimal(layout.initial_state)
        self.n_states = self.n_tangent = len(self.initial_state)
        self.n_controls = layout.n_u
        self.horizon = self.scene.simulation.steps
        self.time_step = self.scene.simulation.dt
        self.parameters = StageParameters(self.horizon)
        self.control_lower: FloatArray = layout.lower_limits(layout.control_limit)
        self.control_upper: FloatArray = layout.control_limit

    def from_minimal(self, x: FloatArray) -> FloatArray:
        """Convert a state in minimal coordinates, shape (n_x,), to the redundant one."""
        kernel = self.kernels.paper_kernel("from_minimal", lanes=1)
        result = np.zeros(kernel.outputs[0].stride)
        kernel([np.ascontiguousarray(x, dtype=np.float64), result], 1)
        return result

    def kernel(self, name: str, *, batched: bool = False) -> Kernel:
        """Return a kernel of `ShootingProblem`."""
        return self.kernels.paper_kernel(name, lanes=None if batched else 1)
