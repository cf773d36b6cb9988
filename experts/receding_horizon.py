"""A receding-horizon expert: the maneuver is optimized anew at every step, over the next stages only.

The whole maneuver is planned once per episode, from where it starts (`ManeuverPlan`). At every step the
expert then solves a shorter problem, from the state that it is given to a horizon beyond which the plan tells
what the rest will cost, to second order. What was found one step ago, shifted by one stage and with its
feedback, is so close to the new optimum that one iteration is enough.

The iterations are Gauss-Newton's. Their model is convex wherever noise and pushes take the state, also where
exact second derivatives have no minimum; near the plan the curvature that they leave out is in the model of
what the rest will cost. Where the cheapest maneuver would end outside of the tolerances, plan and steps
emphasize the final pose as much as reaching the target takes.
"""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dq_space_arm_env import Scene
from dq_space_arm_env.algebra import dual_quaternion
from dq_space_arm_env.scene.start import PLANAR_POSE
from experts.arm_problem import ArmProblem
from experts.backward_sweep import SWEEP_DONE
from experts.box_ddp import BoxDDP
from experts.checks import check_array, check_at_least
from experts.line_search import line_search
from experts.maneuver_plan import ManeuverPlan
from experts.problem import FloatArray, as_problem
from experts.shooting import ShootingWorkspace
from experts.solution import Solution
from experts.window_problem import WindowProblem

WORTHWHILE = 1e-12
"""A step that promises less than this share of the plan's cost is not tried: rounding would decide on it."""


class RecedingHorizonExpert:
    """A policy `action = expert(observation_or_state)`; it owns its work arrays, so give each thread its own.

    Observations are those of `DQSpaceArm-v0`, and tell the stage by the time left; the first one, and one
    with no less time left than the last, begins a new episode. States tell no stage: calls are counted, and
    `reset` begins an episode. A state has n_x entries, an observation one more. Noise in the norm of the pose
    is removed.

    The call that begins an episode plans it first, which takes a fraction of a second; so does `reset` with a
    state. Target and masses are the scene's: where the environment draws them, give the expert
    `env.unwrapped.episode_scene`.

    Attributes:
        maneuver: The scene as a shooting problem of N stages.
        horizon: Stages that are optimized at every step.
        iterations: Iterations per step.
        plan: Plan of the episode; None before it begins.
        control: Last control in N, N m, rad/s, shape (n_u,).
        fallbacks: Actions of this episode that came from the plan's feedback policy u = clip(u_k + K_k (x (-)
            x_k)) since the state was so far off that no finite rollout began there; of the plan's u_k alone
            where not even that is finite.
    """

    def __init__(self, scene: Scene | str | Path, horizon: int = 100, iterations: int = 1) -> None:
        """Prepare; nothing is planned yet.

        Args:
            scene: A scene, the name of a shipped one, or a path to a YAML file.
            horizon: Stages to optimize at every step; the rest of the episode if there are fewer left.
            iterations: Iterations per step; 0 only follows the plan with its feedback.

        Raises:
            SceneError: If the scene cannot be loaded.
            ValueError: If a setting is too small, or the scene has no actuator or one without a limit.
        """
        check_at_least("horizon", horizon, 1)
        check_at_least("iterations", iterations, 0)
        self.maneuver = ArmProblem(scene)
        as_problem(self.maneuver)
        if not np.isfinite(self.maneuver.control_upper).all():
            unlimited = int(np.argmax(~np.isfinite(self.maneuver.control_upper)))
            name = self.maneuver.kernels.layout.control.names[unlimited]
            raise ValueError(f"{name} has no finite limit; actions are fractions of limits, so give it one")
        self.horizon, self.iterations = horizon, iterations
        self.plan: ManeuverPlan | None = None
        self.control: FloatArray = np.zeros(self.maneuver.n_controls)
        self.fallbacks = 0
        self._next_stage = 0
        self._nominal: Solution | None = None
        self._work: ShootingWorkspace | None = None
        self._model_state = np.zeros((1, self.maneuver.n_states))
        self._model_gradient = np.zeros((1, self.maneuver.n_tangent))
        self._model_hessian = np.zeros((1, self.maneuver.n_tangent, self.maneuver.n_tangent))

    def reset(self, observation_or_state: ArrayLike | None = None) -> None:
        """Begin an episode.

        Args:
            observation_or_state: Where it starts, shape (n_x + 1,) or (n_x,), to have it planned now; None to
                have the next call do that.

        Raises:
            ValueError: If it has another shape or is not finite.
            RuntimeError: If the maneuver cannot be simulated from there.
        """
        self.plan, self._work, self._next_stage, self.fallbacks = None, None, 0, 0
        if observation_or_state is not None:
            self._begin(*self._read(observation_or_state))

    def __call__(self, observation_or_state: ArrayLike) -> FloatArray:
        """Choose an action.

        Args:
            observation_or_state: Observation, shape (n_x + 1,), or state, shape (n_x,).

        Returns:
            Inputs as fractions of their limits, in [-1, 1], shape (n_u,).

        Raises:
            ValueError: If it has another shape, is not finite, or tells a time that is not of the episode.
            RuntimeError: If the episode is over, or the maneuver cannot be simulated from its start.
        """
        state, stage = self._read(observation_or_state)
        if self.plan is None or stage < self._next_stage:
            self._begin(state, stage)
        assert self.plan is not None
        work = self._window(self.plan, stage)
        with self.maneuver.emphasized(self.plan.emphasis):
            is_finite = self._optimize(work, state, self.plan.solution.cost)
        if is_finite:
            self._work, self.control = work, work.current.controls[0].copy()
        else:
            self._work, self.control = None, _planned_control(self.plan, state, stage)
            self.fallbacks += 1
        self._next_stage = stage + 1
        return self.control / self.maneuver.control_upper

    def _read(self, observation_or_state: ArrayLike) -> tuple[FloatArray, int]:
        """Return the state and its stage, or say what is wrong with what was given."""
        maneuver = self.maneuver
        given = np.asarray(observation_or_state, dtype=np.float64)
        if given.shape == (maneuver.n_states + 1,):
            check_array("observation", given, given.shape)
            stage = maneuver.horizon - round(given[-1] / maneuver.time_step)
            if stage == maneuver.horizon:
                raise RuntimeError("the observation says that no time is left: the episode is over")
            if not 0 <= stage < maneuver.horizon:
                duration = maneuver.horizon * maneuver.time_step
                raise ValueError(
                    f"observation[{maneuver.n_states}], the time left, is {given[-1]} s; an episode of scene "
                    f"{maneuver.scene.name!r} lasts {duration:g} s"
                )
            state = maneuver.kernels.state_from_observation(given)
            check_array("the state behind the observation", state, state.shape)
            return state, stage
        if given.shape != (maneuver.n_states,):
            raise ValueError(
                f"observation_or_state has shape {given.shape}; expected a state, ({maneuver.n_states},), or "
                f"an observation, ({maneuver.n_states + 1},)"
            )
        check_array("state", given, given.shape)
        if self._next_stage == maneuver.horizon:
            raise RuntimeError(f"the episode's {maneuver.horizon} stages are over: call reset()")
        return self._of_unit_norm(given), self._next_stage

    def _of_unit_norm(self, state: FloatArray) -> FloatArray:
        """A copy of a state, its pose made a unit dual quaternion."""
        layout = self.maneuver.kernels.layout
        stored = list(PLANAR_POSE if layout.planar else range(8))
        pose = np.zeros(8)
        pose[stored] = state[layout.state.pose]
        if not pose[:4].any():
            raise ValueError("the base quaternion of the state is zero; its norm should be 1")
        result = state.copy()
        result[layout.state.pose] = np.array(dual_quaternion.normalize(pose.tolist()))[stored]
        return result

    def _begin(self, state: FloatArray, stage: int) -> None:
        """Plan an episode; the policy of the nominal maneuver is a better first guess than doing nothing."""
        if self._nominal is None:
            self._nominal = BoxDDP(self.maneuver).solve()
        self.plan = ManeuverPlan.make(self.maneuver, state, stage, self._nominal)
        self._work, self._next_stage, self.fallbacks = None, stage, 0

    def _window(self, plan: ManeuverPlan, stage: int) -> ShootingWorkspace:
        """Prepare the problem that starts at a stage, with what is known of its solution as the reference.

        That is the last solution, if it is one stage old, and the plan beyond its end; else the plan.
        """
        last = self._work if stage == self._next_stage else None
        horizon = min(self.horizon, self.maneuver.horizon - stage)
        end = stage + horizon
        work = self._workspace(horizon, ends_early=end < self.maneuver.horizon)
        kept = 0
        if last is not None:
            kept = last.problem.horizon - 1
            work.current.states[:kept] = last.current.states[1 : kept + 1]
            work.current.controls[:kept] = last.current.controls[1:]
            work.update.gains[:kept] = last.update.gains[1:]
        solution = plan.solution
        rest = slice(stage + kept - plan.first_stage, end - plan.first_stage)
        work.current.states[kept:horizon] = solution.states[rest]
        work.current.controls[kept:] = solution.controls[rest]
        work.update.gains[kept:] = solution.feedback_gains[rest]
        if end < self.maneuver.horizon:
            self._model_state[0] = solution.states[rest.stop]
            self._model_gradient[0] = plan.value_gradients[rest.stop]
            self._model_hessian[0] = plan.value_hessians[rest.stop]
        return work

    def _workspace(self, horizon: int, *, ends_early: bool) -> ShootingWorkspace:
        """The last workspace if it has the right size; it changes only where the end of the episode nears."""
        if self._work is not None:
            problem = self._work.problem
            assert isinstance(problem, WindowProblem)
            if (problem.horizon, problem.ends_early) == (horizon, ends_early):
                return self._work
        model = (self._model_state, self._model_gradient, self._model_hessian) if ends_early else ()
        return ShootingWorkspace(WindowProblem(self.maneuver, horizon, model), second_order=False)

    def _optimize(self, work: ShootingWorkspace, state: FloatArray, scale: float) -> bool:
        """Follow the reference from a state, and improve on that; return whether the rollout is finite."""
        work.trial.states[0] = state
        if not np.isfinite(work.try_step(0.0)):
            return False
        work.accept()
        work.trial.states[0] = state
        for _ in range(self.iterations):
            work.differentiate()
            outcome = work.sweep(0.0)
            if outcome.status != SWEEP_DONE or outcome.promise(1.0) <= WORTHWHILE * scale:
                break
            if line_search(work, outcome) == 0.0:
                break
        return True


def _planned_control(plan: ManeuverPlan, state: FloatArray, stage: int) -> FloatArray:
    """Control of the plan's feedback policy, or the plan's own where the feedback is not finite."""
    index = stage - plan.first_stage
    with np.errstate(over="ignore", invalid="ignore"):
        control = plan.policy(state, index)
    return control if np.isfinite(control).all() else plan.solution.controls[index].copy()
