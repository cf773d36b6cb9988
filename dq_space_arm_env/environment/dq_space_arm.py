"""The environment `DQSpaceArm-v0`: a spacecraft brings the tip of its arm to a target pose at rest.

`DQSpaceArmEnv.step` calls one compiled function. Its equations: action to inputs, reward, success and end of the episode in
`task/episode.py` (`command`, `step`), cost and observation in `task/equations.py`, motion in `dynamics/`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from struct import Struct
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.common.real_arrays import DOUBLE, SINGLE, real_array
from dq_space_arm_env.compiler.random_draws import generator_of, generator_state
from dq_space_arm_env.environment.reset_options import (
    GivenStart,
    check_scene,
    checked_options,
    given_start,
    saved_state,
)
from dq_space_arm_env.environment.saved_states import PicklesEpisodes, checked_state, scene_to_copy
from dq_space_arm_env.environment.specification import (
    PlainSpec,
    action_space,
    frames_per_second,
    observation_space,
)
from dq_space_arm_env.kernels import compile_scene
from dq_space_arm_env.kernels.bound import BoundKernel, KernelCall
from dq_space_arm_env.kernels.stages import present_parameters
from dq_space_arm_env.scene import Scene, load_scene
from dq_space_arm_env.scene.path import given_path
from dq_space_arm_env.scene.start import episode_scene
from dq_space_arm_env.task.step_report import FLAGS, MEMORY, REPORT, grouped, report_names
from dq_space_arm_env.viewing.payload_places import Payloads, leaves_tip
from dq_space_arm_env.viewing.picture_format import PictureFormat

if TYPE_CHECKING:
    from dq_space_arm_env.viewing.rendering import Renderer

Array = NDArray[Any]

_ROW = np.zeros(1, dtype=np.int64)  # of the one state

# A view of the action, and the function that takes a step with it.
_StepCall = tuple[Any, Callable[[], None]]


def _step_call(kernel: BoundKernel, arrays: Mapping[str, Array], before: Array | None) -> _StepCall:
    """Bind a step to the arrays of an environment, and to one of its own for actions of the kernel's type.

    It copies the memory to `before` first, if there is such an array.
    """
    (spec,) = (spec for spec in kernel.inputs if spec.name == "action")
    action: Any = np.zeros(spec.stride, spec.dtype)
    take_step = KernelCall(kernel, {**arrays, "action": action}).of_one_row()
    if before is None:
        return memoryview(action), take_step
    kept: Any = before
    memory: Any = arrays["memory"]
    source, target = memoryview(memory), memoryview(kept)

    def keep_memory_and_step() -> None:
        target[:] = source
        take_step()

    return memoryview(action), keep_memory_and_step


class DQSpaceArmEnv(gymnasium.Env[Array, NDArray[Any]], PicklesEpisodes):
    """
    ## Description

    A free-floating spacecraft carries an arm with revolute joints and a massless spherical wrist. Forces and torques on the base, joint torques and the
    wrist's Euler rates have to bring the tip of the arm to a target pose at rest, with little effort: the pose-stabilization maneuver of
    A. Valverde and P. Tsiotras, "Modeling of Spacecraft-Mounted Robot Dynamics and Control Using Dual Quaternions" (ACC 2018).
    The dynamics are the Newton-Euler equations of the whole system: nothing holds the base in place.

    A *scene* defines the robot, its limits, the target, the cost, the start and the time step. Parts that a scene lacks (wrist, thrusters, wheels,
    joints) appear neither in the observation nor in the action. The tables show scene `paper`.

    ## Action Space

    A `Box(-1, 1, (12,), float32)`: inputs as fractions of their limits, which have to be finite, constant over a time step. Values beyond the bounds are
    clipped; NaN raises an error. A float64 action is used at full precision. `env.unwrapped.kernels.layout` converts: `to_control(action)`, `to_action(control)`.

    | Num | Action                                                 | Min  | Max | Unit  | Limit at 1 |
    |-----|--------------------------------------------------------|------|-----|-------|------------|
    | 0-2 | force on the base at its center of mass, base axes     | -1   | 1   | N     | 10         |
    | 3-5 | torque on the base, base axes                          | -1   | 1   | N m   | 5          |
    | 6-8 | torques of joints 1 to 3                               | -1   | 1   | N m   | 2          |
    | 9-11| wrist's Euler rates psi, theta, phi                    | -1   | 1   | rad/s | 0.5        |

    ## Observation Space

    A `Box` of shape `(24,)`, float64; a simulation whose numbers grow toward the bound of 1e6 counts as diverged:

    | Num   | Observation                                                           | Min  | Max | Unit  |
    |-------|-----------------------------------------------------------------------|------|-----|-------|
    | 0-3   | error dual quaternion q_{D/G} = q_{G/I}* q_{D/I}, real part            | -1   | 1   | -     |
    | 4-7   | the same, dual part: half the position error (times rotation)         | -1e6 | 1e6 | m     |
    | 8-10  | angular velocity of the base, base axes                               | -1e6 | 1e6 | rad/s |
    | 11-13 | velocity of the base's center of mass, base axes                      | -1e6 | 1e6 | m/s   |
    | 14-16 | angles of joints 1 to 3, not wrapped                                  | -1e6 | 1e6 | rad   |
    | 17-19 | wrist angles psi, theta, phi, not wrapped                             | -1e6 | 1e6 | rad   |
    | 20-22 | rates of joints 1 to 3                                                | -1e6 | 1e6 | rad/s |
    | 23    | time left in the episode                                              | 0    | T   | s     |

    q_{X/Y} is the pose of X with respect to Y, * conjugates; I is the inertial frame, G the tip, D the target. q_{D/G} and -q_{D/G} are the same pose:
    the sign is chosen at reset such that the scalar part is not negative, and carried along by continuity, as in the cost. The observation determines the
    state, but for whether a catch was met, which `info["caught"]` tells; in a planar scene the error has only the four entries that are not identically zero.

    Where the target moves, two twists stand before the time left, in tip axes, with the wrist held (in a planar scene three entries each; bounds are 1e12):

    | Num   | Observation, scene `tumbling-target`                                  | Min  | Max | Unit  |
    |-------|-----------------------------------------------------------------------|------|-----|-------|
    | 23-25 | angular velocity of the tip relative to the target                    | -1e12 | 1e12 | rad/s |
    | 26-28 | velocity of the tip relative to the target                            | -1e12 | 1e12 | m/s  |
    | 29-31 | angular velocity of the target                                        | -1e12 | 1e12 | rad/s |
    | 32-34 | velocity of the target, as if it reached to the tip                   | -1e12 | 1e12 | m/s  |
    | 35    | time left in the episode                                              | 0    | T   | s     |

    Other scenes add entries between the joint rates and the twists, or the time left, in this order:

    | Observation                                                       | where                                          | Unit     |
    |-------------------------------------------------------------------|------------------------------------------------|----------|
    | angles, then rates of motors                                      | gears are elastic                              | rad, rad/s |
    | axial momenta of the wheels                                       | there are reaction wheels                      | N m s    |
    | mass of the propellant                                            | thrusters have a tank                          | kg       |
    | controls before, `layout.previous_controls`                       | their rates are limited                        | N, N m, rad/s |
    | commands on their way, outputs, `layout.state.drives`             | actuators act late, or lag                     | N, N m, rad/s |
    | number of the phase, from 0                                       | there are phases                               |          |
    | pose of the target, q_{D/I}                                       | `target.observed`                              | 1, m     |
    | masses, relative change                                           | `spread.observed`                              |          |
    | error dual quaternions of other tips, scalar part at least 0      | there are `other_tips`                         | 1, m     |
    | margins of constraints, tanh(-c / scale)                          | constraints have `observed`                    |          |

    Actions follow in this order: base force, base torque, joint torques, wrist rates, torques of wheels, forces of thrusters. An action below 0
    turns a thruster off, and a pulse shorter than the shortest does not fire; when the tank is empty the thrusters stop. At its largest speed a wheel's
    torque stops, and a motor takes no more than its power: what then acts is less than the action asks for. `dq-space-arm scenes show SCENE` prints the
    tables of any scene.

    ## Rewards

    The reward of a step is minus the paper's stage cost, of the state before the step and of the action; the last step adds minus the terminal cost of
    the state after it. The return of an episode is therefore exactly -J. The weights are those of scene `paper`:

    | Term (key in `info`)          | Formula                                                | Weight                               |
    |-------------------------------|--------------------------------------------------------|--------------------------------------|
    | `cost_pose`                   | (q_{G/I} - q_{D/I})' W (q_{G/I} - q_{D/I})             | 15                                   |
    | `cost_base_velocity`          | (omega - omega_D)' W (omega - omega_D), 6 components   | 1                                    |
    | `cost_control`                | u' R u, in N, N m, rad/s, after clipping by actuators  | 10 force, 1 torque, 0.01 joints, 0.1 wrist |
    | `terminal_cost_pose`          | as `cost_pose`, at the end; 0 before                   | 150                                  |
    | `terminal_cost_base_velocity` | as `cost_base_velocity`, at the end; 0 before          | 1                                    |

    omega_D is the scene's `target.base_velocity`, which may be relative to a target that moves (`target.base_velocity_relative`).

    Scenes may weigh the tip's twist relative to the target; `info` then has these terms too:

    | Term (key in `info`)          | Formula                                                | Weight                               |
    |-------------------------------|--------------------------------------------------------|--------------------------------------|
    | `cost_tip_twist`              | w' W w, w the relative twist with the wrist's rates    | the scene's `cost.tip_twist`         |
    | `terminal_cost_tip_twist`     | the same at the end, with the wrist held; 0 before     | `cost.terminal_tip_twist`: 1e5 in `tracking` |

    `info` also holds the `attitude_error` [deg] and `position_error` [m] of the tip (of several the worst), `is_success` (all errors within the scene's tolerances, here 3 deg and 0.1 m, and no
    catch has failed) and `diverged`; where the target moves, or success asks for it, the tip's `angular_velocity_error` [deg/s] and `velocity_error` [m/s] relative to the target with the
    wrist held. In a scene with phases it holds the `phase` of the next step, counted from 0; where something is caught `caught`, 1 unless the catch has failed, and in
    the step of the catch the impulse on the payload, `shock` [N s] and `angular_shock` [N m s]. `reset` returns the same keys, with costs of zero; where target, masses or anything else vary, its `info["parameters"]` has their
    values in this episode by name.

    Where a scene has constraints, `info["constraints"]` has every residual by its name, which is at most 0 where the constraint holds, of the state after
    the step and of the input, and `info["cost"]` the sum of their violations, each over its tolerance (the convention of safe reinforcement learning; the
    reward is without). What is exact at the end is charged there.

    ## Starting State

    `reset(seed=...)` draws the initial state from the scene's spread, uniformly per component, and the target, masses and inertias where they have a spread
    (scenes `random-target` and `random-masses`). `reset(options=...)` gives what is not to be drawn:

    | Option                 | Meaning                                                                                                                    |
    |------------------------|----------------------------------------------------------------------------------------------------------------------------|
    | `{"nominal": True}`    | the scene's initial state, target and masses                                                                               |
    | `{"initial_state": x}` | a state x, entries as in `env.unwrapped.kernels.layout.state`; target and masses are nominal                               |
    | `{"target": q}`        | the target of a scene in which it varies, alone or with the others (at the start if it moves; its velocity in its own axes stays) |
    | `{"parameters": p}`    | all that varies besides the state, entries as in `env.unwrapped.kernels.parameters`, likewise                              |
    | `{"state": s}`         | alone: the middle of an episode, where `s = env.unwrapped.get_state()` was called; it goes on to the same bits             |

    `copy.deepcopy` and `pickle` keep a running episode likewise. `env.unwrapped.episode_scene` is the scene of the running episode with everything drawn or
    given as plain numbers: what an optimal controller may know.

    ## Episode End

    1. Termination: the scene's number of steps (1000) is reached. The observation holds the time left and the task has a terminal cost, so this is the end of
       the task, not a truncation. `gymnasium.make(..., max_episode_steps=10)` truncates before the step that carries the terminal cost: shorten `simulation.steps`.
    2. Termination: the simulation diverged (the state is not finite, or its norm exceeds 5e5). `info["diverged"]` is true, and this and the remaining steps are
       charged with a bound of what any motion from there could cost, so ending early never pays.
    3. Termination: a constraint with `terminates: true` is violated by more than its tolerance. The episode is no success, and is charged as after a divergence.

    A step is divided where it would err by more than the scene's `simulation.tolerance` (1e-3 rad or m by default): motions too fast for the time step stay
    sound, and slow ones cost an estimate. `info["step_error"]` is that estimate in units of the tolerance, 0 after a reset, NaN where nothing estimates it (`tolerance: off`, or a method
    without an estimate, or a step that is given up: the simulation diverged). Many accurate steps of a chaotic motion may still end elsewhere: `env.unwrapped.kernels.numerical_error(states, controls)` tells.

    ## Arguments

    | Parameter     | Type                     | Default   | Description                                            |
    |---------------|--------------------------|-----------|--------------------------------------------------------|
    | `scene`       | **str, Path, dict or Scene** | `"paper"` | name of a shipped scene, path of a YAML file, its content as a mapping, or a `Scene` |
    | `render_mode` | **str or None**          | `None`    | `"rgb_array"`, or `"human"` for a window, which needs a display and the extra `render` |
    | `width`, `height` | **int**              | 640, 480  | size of the pictures, pixels                           |
    | `default_camera_config` | **dict or None** | `None`  | camera placement as in Gymnasium's MuJoCo environments: any of `azimuth`, `elevation` (viewing direction, deg; negative elevations look down), `lookat` (point in the center of the picture, m) and `distance` from it (m); defaults keep start, target and the arm between them in view |

    ```python
    >>> import gymnasium
    >>> import dq_space_arm_env
    >>> env = gymnasium.make("DQSpaceArm-v0", scene="paper")
    >>> observation, info = env.reset(seed=0)
    >>> observation.shape, env.action_space.shape
    ((24,), (12,))

    ```

    ## Vectorized environment

    `DQSpaceArmVectorEnv` steps many sub-environments with one call of vectorized machine code, bit-equal to single environments with the same seeds.
    After the end of an episode the next step resets (`autoreset_mode="NextStep"`), or the same step (`"SameStep"`, with `final_obs` and `final_info`), or the
    caller (`"Disabled"`). `reset(seed=s)` seeds copy i with s + i; `options={"reset_mask": mask}` resets some, and `initial_state`, `target` and `parameters`
    may have a row for each. `truncated` is always false; `max_episode_steps` is refused: set `simulation.steps`. `threads=2` shares the copies of a step between two
    cores. `perturb(increments)` pushes the states; `get_state(rows)` and `set_state(state, rows)` save and put back some episodes.

    ```python
    >>> venv = gymnasium.make_vec("DQSpaceArm-v0", num_envs=3)
    >>> venv
    DQSpaceArmVectorEnv(DQSpaceArm-v0, num_envs=3)

    ```

    ## Version History

    * v0: Initial version.
    """

    spec = PlainSpec()
    metadata: dict[str, Any] = {  # noqa: RUF012 - as in every Gymnasium environment
        "render_modes": ["human", "rgb_array"],
        "render_fps": 60,
    }

    def __init__(
        self,
        scene: Scene | Mapping[str, Any] | str | Path = "paper",
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        default_camera_config: Mapping[str, Any] | None = None,
    ) -> None:
        """Load a scene and compile its step, or take it from the cache.

        Args:
            scene: Name of a shipped scene, path of a YAML file, its content as a mapping, or a scene.
            render_mode: None, "rgb_array" or "human".
            width: Width of the pictures, pixels.
            height: Height of the pictures, pixels.
            default_camera_config: Any of "azimuth" and "elevation" [deg], "distance" [m] and "lookat", shape (3,), m.

        Raises:
            SceneError: If the scene cannot be loaded.
            ValueError: If the scene has no actuator, or one without a finite limit, or starts too far from the origin; if the
                render mode is unknown; or if size or camera of the pictures is invalid.
        """
        self._picture = PictureFormat.checked(width, height, default_camera_config)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            modes = ", ".join(self.metadata["render_modes"])
            raise ValueError(f"render_mode: {render_mode!r} is unknown; choose from {modes}, or None")
        self.scene = load_scene(scene)
        picture = width, height, default_camera_config
        PicklesEpisodes.__init__(self, scene_to_copy(scene, self.scene), render_mode, *picture)
        self.kernels = compile_scene(self.scene)
        self.action_space, self.observation_space = (
            action_space(self.kernels),
            observation_space(self.kernels),
        )
        check_scene(self.scene)
        self.render_mode = render_mode
        self.metadata = {**type(self).metadata, "render_fps": frames_per_second(self.scene)}
        self._bind_kernels()
        names = report_names(self.scene)[1:]
        self._more_names = () if names == REPORT[1:] else names
        self._begun, self._over = False, True
        self._trail: list[Array] = []
        self._payloads = Payloads(self.kernels, 1) if leaves_tip(self.scene) else None
        self._renderer: Renderer | None = None

    def _bind_kernels(self) -> None:
        """Allocate the arrays of the compiled functions, whose addresses a step passes unchanged."""
        start = self.kernels.kernel("environment_start", lanes=1)
        observe = self.kernels.kernel("environment_observe", lanes=1)
        step = self.kernels.kernel("environment_step_float32_actions", lanes=1)
        arrays = {
            spec.name: np.zeros(spec.stride, dtype=spec.dtype)
            for kernel in (start, observe, step)
            for spec in (*kernel.inputs, *kernel.outputs)
        }
        if "episode_parameters" in arrays:
            arrays["episode_parameters"] = arrays["parameters"]
        # Report and flags side by side: Python's numbers of both in one call.
        count = arrays["report"].size
        form = Struct(f"{count}d{len(FLAGS)}?")
        numbers: Any = np.zeros(form.size, dtype=np.uint8)
        self._unpack, self._numbers = form.unpack, numbers
        arrays["report"] = numbers[: 8 * count].view(np.float64)
        arrays["flags"] = numbers[8 * count :].view(np.bool_)
        # A step reads state and memory before it writes them: they stay where they are.
        arrays["x_kept"], arrays["memory_kept"] = arrays["x"], arrays["memory"]
        self._start, self._observe = KernelCall(start, arrays), KernelCall(observe, arrays)
        self._x, self._draws = arrays["x"], arrays["draws"]
        self._memory = arrays["memory"]
        # A step that diverges changes only what depends on the stage: a target that moves, and phases.
        staged = self._memory.size > len(MEMORY) or self.scene.phases
        self._memory_before = np.zeros_like(self._memory) if staged else None
        self._arrays, self._step = arrays, _step_call(step, arrays, self._memory_before)
        self._parameters = arrays.get("parameters", np.zeros(0, dtype=self.kernels.dtype))
        self._path = given_path(self.scene, self.scene.simulation.steps) if "following" in arrays else None
        self._following = arrays.get("following", np.zeros(0))
        self._observation = arrays["observation"]

    @cached_property
    def _step_of_doubles(self) -> _StepCall:
        """The step for actions of any type but that of the action space."""
        kernel = self.kernels.kernel("environment_step", lanes=1)
        return _step_call(kernel, self._arrays, self._memory_before)

    @property
    def state(self) -> Array:
        """The state, shape (n_x,), units as in `kernels.layout.state`; a copy. `ResetNeeded` before the first reset."""
        self._require_reset("reading the state")
        return self._x.copy()

    @property
    def parameters(self) -> Array:
        """What varies between episodes besides the state: target at the start, masses, and whatever the scene names, shape (n_p,); a copy.

        `kernels.parameters` has the names and units of the entries. `ResetNeeded` before the first reset.
        """
        self._require_reset("reading the parameters")
        return self._parameters.copy()

    @property
    def target(self) -> Array:
        """Pose q_{D/I} of the target, now if it moves, shape (8,), dimensionless and m; a copy. `ResetNeeded` before the first reset."""
        self._require_reset("reading the target")
        return self.kernels.layout.target_with(self.stage_parameters)

    @property
    def stage_parameters(self) -> Array:
        """`parameters`, with pose and velocity of a target that moves as they are now, shape (n_p,); a copy. `ResetNeeded` before the first reset."""
        self._require_reset("reading the parameters")
        present: Array = present_parameters(self.kernels, self._parameters[None], self._memory[None])[0]
        return present

    @property
    def elapsed_steps(self) -> int:
        """Time steps that this episode has taken. `ResetNeeded` before the first reset."""
        self._require_reset("reading the elapsed steps")
        return int(self._memory[0])

    @property
    def episode_scene(self) -> Scene:
        """The scene with the parameters of this episode as constants, without a spread. `ResetNeeded` before the first reset."""
        self._require_reset("asking for the episode's scene")
        return episode_scene(self.scene, self._parameters.tolist())

    def get_state(self) -> dict[str, Array]:
        """Copy what all later steps and resets depend on.

        Returns:
            Arrays by name, for `set_state`, of this environment or another of the same scene: the state "x", shape (n_x,); "memory" of the
            step (number, terms of the stage cost, target that moves, whether the payload is held), and "parameters"; in scenes that let a payload go "adrift", shape (15,), its pose and
            twist then, see `Payloads`; whether the episode is "over"; and the state of the random "generator". `ResetNeeded` before the first reset.
        """
        self._require_reset("get_state()")
        state = {**self._kept(), "over": np.array(self._over)}
        return {name: array.copy() for name, array in state.items()} | {
            "generator": generator_state(self.np_random.bit_generator)
        }

    def set_state(self, state: Mapping[str, Array]) -> None:
        """Go on where `get_state` was called: the same actions give the same bits. The trail in pictures begins anew.

        Args:
            state: What `get_state` returned, arrays of its shapes.

        Raises:
            ValueError: If an array is missing, has another shape or type, or is not finite; nothing is changed then.
        """
        expected = {
            **self._kept(),
            "over": np.array(True),
            "generator": np.empty(4, np.uint64),
        }
        found = checked_state(state, expected, self.scene.simulation.steps)
        self._begin_trail()
        for name, array in self._kept().items():
            array[...] = found[name]
        self._begun, self._over = True, bool(found["over"])
        self.np_random = generator_of(found["generator"])

    def _kept(self) -> dict[str, Array]:
        kept = {"x": self._x, "memory": self._memory, "parameters": self._parameters}
        return kept if self._payloads is None else {**kept, "adrift": self._payloads.adrift[0]}

    def _require_reset(self, what: str) -> None:
        if not self._begun:
            raise ResetNeeded(f"call reset() before {what}")

    def step(self, action: ArrayLike) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Apply an action for one time step.

        Args:
            action: Inputs as fractions of their limits, shape (n_u,); clipped to [-1, 1].

        Returns:
            Observation, reward, terminated, truncated (always False), info.

        Raises:
            ResetNeeded: Before the first reset, and after the end of an episode.
            TypeError: If the action is masked, or not of real numbers.
            ValueError: If the action has a wrong shape or a NaN; nothing has moved then.
        """
        if self._over:
            state = "is over" if self._begun else "has not begun"
            raise ResetNeeded(f"the episode {state}: call reset() before step()")
        # Arrays of the action space's type are taken as they are; telling them by identity costs nothing.
        if type(action) is np.ndarray and action.dtype is SINGLE:
            given, take_step = self._step
        else:
            action = real_array("action", action, DOUBLE)
            given, take_step = self._step_of_doubles
        try:
            given[:] = action  # faster than NumPy, which would broadcast
        except ValueError:
            raise ValueError(f"action: shape {action.shape}, should be {given.shape}") from None
        if self._path is not None:
            self._following[...] = self._path[int(self._memory[0]) + 1]
        take_step()  # inputs, motion, observation, reward and end of the episode: task/episode.py
        row = self._unpack(self._numbers)
        over = row[-3]
        if over and np.isnan(action).any():
            if self._memory_before is not None:
                self._memory[...] = self._memory_before
            raise ValueError(f"action: {action!r} holds NaN, should be numbers in [-1, 1]")
        self._over = over
        if self._payloads is not None and self._memory[0] in self._payloads.releases:
            self._payloads.follow(self._x[None], self._memory[None])
        if self.render_mode is not None:
            self._show()
        if self._more_names:
            reward, *report, _, success, diverged = row
            flags = {"is_success": success, "diverged": diverged}
            info = dict(zip(self._more_names, report, strict=True)) | flags
            if self.scene.constraints:
                info = grouped(info)
        else:
            # Written out: a call, a loop over names or a list would make a step some per cent slower.
            reward, pose, speed, effort, end_pose, end_speed, angle, gap, error, over, success, diverged = row
            info = {
                "cost_pose": pose,
                "cost_base_velocity": speed,
                "cost_control": effort,
                "terminal_cost_pose": end_pose,
                "terminal_cost_base_velocity": end_speed,
                "attitude_error": angle,
                "position_error": gap,
                "step_error": error,
                "is_success": success,
                "diverged": diverged,
            }
        return self._observation.copy(), reward, over, False, info

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Seed of the random start; None keeps the generator.
            options: {"nominal": True} for the scene's initial state, or {"initial_state": x} with x of shape (n_x,);
                {"target": q} for the target q_{D/I} of shape (8,), in a scene where it varies; {"parameters": p} for all that varies,
                shape (n_p,), entries as in `kernels.parameters`; {"state": s} alone to go on in the
                middle of an episode, see `get_state`, with its generator unless a seed is given.

        Returns:
            Observation and info.

        Raises:
            ValueError: If the options are no mapping, or one is unknown or excludes another; if state or target has a wrong shape, is not finite, or its pose is not a unit
                dual quaternion; if the target is too far away; if actuators keep what is beyond their limits in the state, or a tank less than nothing; if the scene's target does not vary; or if no scene
                may have the parameters (`SceneError`).
        """
        given = checked_options(options)
        saved = saved_state(given)
        if saved is not None:
            if seed is not None:
                seeding.np_random(seed)  # if it is refused, nothing has changed
            self.set_state(saved)
            super().reset(seed=seed)
        else:
            start = given_start(self.kernels, given)  # if it is refused, nothing has changed
            super().reset(seed=seed)
            self._begin(start)
        memory = self._memory.copy()
        self._observe.on_rows(_ROW)
        if saved is not None:  # its costs are those of the step before, which may be rounded otherwise
            self._memory[...] = memory
        if self.render_mode is not None:
            self._show()
        _, *report, _, success, diverged = self._unpack(self._numbers)
        info = grouped(dict(zip(self._more_names or REPORT[1:], report, strict=True)))
        info |= {"is_success": success, "diverged": diverged}
        if self.kernels.n_p:
            info["parameters"] = dict(
                zip(self.kernels.parameters.names, self._parameters.tolist(), strict=True)
            )
        return self._observation.copy(), info

    def _begin(self, start: GivenStart) -> None:
        """Draw an episode, except for what is given."""
        drawn = start.state is None
        self._draws[:] = self.np_random.uniform(-1.0, 1.0, self._draws.shape) if drawn else 0.0
        self._start.on_rows(_ROW)
        start.apply(self.kernels, self._x, self._parameters)
        moving = list(self.kernels.parameters.moving)
        self._memory[len(MEMORY) : len(MEMORY) + len(moving)] = self._parameters[moving]
        self._begun, self._over = True, False
        self._begin_trail()

    def _begin_trail(self) -> None:
        """Forget what was before, which pictures show."""
        self._trail = []
        if self._payloads is not None:
            self._payloads.adrift[:] = np.nan

    def _show(self) -> None:
        """Extend the tip's trail, and update the window."""
        self._trail.append(np.array(poses.position(self.kernels.tip_pose(self._x).tolist())))
        if self.render_mode == "human":
            self.render()

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the present state.

        Returns:
            Picture of shape (height, width, 3), uint8, for render mode "rgb_array"; None for "human", which shows a window.

        Raises:
            ResetNeeded: Before the first reset.
            DependencyNotInstalled: If a window needs the extra `render` and it is not installed.
            Error: If a window needs a display and there is none (`gymnasium.error.Error`).
        """
        if self.render_mode is None:
            gymnasium.logger.warn(
                'render() does nothing without a render mode, e.g. gymnasium.make("DQSpaceArm-v0", render_mode="rgb_array")'
            )
            return None
        self._require_reset("render()")
        if self._renderer is None:
            from dq_space_arm_env.viewing.rendering import Renderer

            self._renderer = Renderer(self.scene, self._picture)
        parameters, layout = self.stage_parameters, self.kernels.layout
        target, payload = layout.target_with(parameters), None
        if self._payloads is not None:
            payload = self._payloads.poses(self._memory[None], self._parameters[None], target[None])[0]
        self._renderer.aim_at(target, layout.target_body_with(parameters), payload)
        frames, trail = self.kernels.frame_poses(self._x), np.array(self._trail).reshape(-1, 3)
        if self.render_mode == "rgb_array":
            return self._renderer.draw(frames, trail)
        self._renderer.show(frames, trail, self.metadata["render_fps"])
        return None

    def close(self) -> None:
        """Close the window, if there is one; may be called again."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
