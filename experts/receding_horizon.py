"""A receding-horizon expert (model predictive control): every step re-optimizes the next stages.

The whole maneuver is planned once per episode, from its start (`ManeuverPlan`). Every step then solves a
shorter problem from the given state, whose terminal cost is the plan's value function, to second order. The
previous solution, shifted by one stage and with its feedback, is so close to the new optimum that one
iteration is enough.

The iterations are Gauss-Newton's: their model is convex wherever noise and pushes take the state, even where
exact second derivatives have no minimum; near the plan the value function contains the curvature that they
neglect. Where the cheapest maneuver would end outside the tolerances, plan and steps emphasize the final pose
as much as reaching the target requires.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from dq_space_arm_env import Scene
from dq_space_arm_env.algebra import dual_quaternion
from dq_space_arm_env.scene.start import PLANAR_POSE
from experts.ddp.box_ddp import BoxDDP
from experts.ddp.shooting import ShootingWorkspace, line_search
from experts.ddp.solution import Policy, Solution, StopReason
from experts.guesses.guided import GuidedDDP
from experts.problems.arm_problem import ArmProblem, WindowProblem, as_problem
from experts.problems.shooting_problem import FloatArray, check_array, check_at_least

WORTHWHILE = 1e-12
"""A smaller predicted reduction, relative to the plan's cost, is not tried: rounding would decide."""


@dataclass(frozen=True, eq=False)
class ManeuverPlan:
    """An optimal maneuver from a stage of the episode to its end; M stages."""

    first_stage: int  # of the episode
    solution: Solution
    policy: Policy  # of the solution; counts stages from the plan's start
    # factor of the final pose's weights at which the solution is a minimum: 1, or as much as reaching the
    # target requires (`reaching`)
    emphasis: float
    Vx: FloatArray  # at every stage, with this emphasis, shape (M, n_t)
    # at every stage, shape (M, n_t, n_t), without negative curvature: off the plan it would predict costs
    # without a lower bound
    Vxx: FloatArray

    @classmethod
    def make(cls, maneuver: ArmProblem, state: FloatArray, stage: int, known: Solution) -> Self:
        """Plan from a state at a stage; the policy of a known solution of the whole maneuver is a guess.

        Raises:
            RuntimeError: If the maneuver cannot be simulated or differentiated from this state.
        """
        problem = WindowProblem(maneuver, maneuver.horizon - stage)
        rest = replace(
            known,
            states=known.states[stage:],
            controls=known.controls[stage:],
            feedback_gains=known.feedback_gains[stage:],
        )
        # At stage 0 the problem is the maneuver itself, which adds the tip's screw motion to the guesses.
        solver = GuidedDDP(maneuver if stage == 0 else problem, library=[rest])
        solution = solver.solve(state)
        emphasis = float(solution.metadata["emphasis"])
        exact = problem.has_second_order
        work = ShootingWorkspace(problem, second_order=exact, keep_values=True)
        with maneuver.emphasized(emphasis):
            work.start(state, solution.controls)
            work.differentiate()
            if exact:
                work.differentiate_twice()
            # The exact model may have no minimum where the solver ran out of iterations.
            models = (True, False) if exact else (False,)
            found = any(work.backward_pass(0.0, exact=model).completed for model in models)
        if solution.stop_reason is StopReason.DIVERGED or not found:
            raise RuntimeError(f"there is no plan from the state at stage {stage}: {solution.message}")
        hessians = _convex_part(work.update.Vxx_all)
        return cls(stage, solution, solution.policy(), emphasis, work.update.Vx_all, hessians)


def _convex_part(matrices: FloatArray) -> FloatArray:
    """Set the negative eigenvalues of symmetric matrices to zero."""
    values, vectors = np.linalg.eigh(matrices)
    return np.ascontiguousarray(vectors * np.maximum(values, 0.0)[:, None, :] @ vectors.transpose(0, 2, 1))


class RecedingHorizonExpert:
    """A policy `action = expert(observation_or_state)`; it owns its work arrays, so give each thread its own.

    Observations of `DQSpaceArm-v0` reveal the stage by the time left; the first one, and any with no less
    time left than the last, begins a new episode. States do not reveal it: calls are counted, and `reset`
    begins an episode. A state has n_x entries, an observation one more. Poses are normalized.

    The call that begins an episode plans it first, which takes a fraction of a second; so does `reset` with a
    state. Target and masses are those of the scene: where the environment draws them, pass
    `env.unwrapped.episode_scene`.

    Attributes:
        maneuver: The scene as a shooting problem of N stages.
        horizon: Stages optimized at every step.
        iterations: Iterations per step.
        plan: Plan of the episode; None before it begins.
        control: Last control in N, N m, rad/s, shape (n_u,).
        fallbacks: Actions of this episode from the plan's feedback policy u = clip(u_k + K_k (x (-) x_k)), or
            from u_k alone where that is not finite, because no finite rollout started at the state.
    """

    def __init__(self, scene: Scene | str | Path, horizon: int = 100, iterations: int = 1) -> None:
        """Prepare the expert; planning comes later.

        Args:
            scene: A scene, the name of a shipped one, or a path to a YAML file.
            horizon: Stages to optimize at every step, or the rest of the episode if that is shorter.
            iterations: Iterations per step; 0 only applies the plan's feedback.

        Raises:
            SceneError: If the scene cannot be loaded.
            ValueError: If a setting is too small, or the scene has no actuators or one without a limit.
        """
        check_at_least("horizon", horizon, 1)
        check_at_least("iterations", iterations, 0)
        self.maneuver = ArmProblem(scene)
        as_problem(self.maneuver)
        if not np.isfinite(self.maneuver.control_upper).all():
            unlimited = int(np.argmax(~np.isfinite(self.maneuver.control_upper)))
            name = self.maneuver.kernels.layout.control.names[unlimited]
            raise ValueError(f"{name} has no finite limit, but actions are fractions of limits: give it one")
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
            observation_or_state: Its start, shape (n_x + 1,) or (n_x,), to plan now; None plans in the next
                call.

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
            ValueError: If it has another shape, is not finite, or its time left exceeds the episode.
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
        """Return the state and its stage."""
        maneuver = self.maneuver
        given = np.asarray(observation_or_state, dtype=np.float64)
        if given.shape == (maneuver.n_states + 1,):
            check_array("observation", given, given.shape)
            stage = maneuver.horizon - round(given[-1] / maneuver.time_step)
            if stage == maneuver.horizon:
                raise RuntimeError("the observation has no time left: the episode is over")
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
        """Return a state with its pose normalized to a unit dual quaternion."""
        layout = self.maneuver.kernels.layout
        stored = list(PLANAR_POSE if layout.planar else range(8))
        pose = np.zeros(8)
        pose[stored] = state[layout.state.pose]
        if not pose[:4].any():
            raise ValueError("the base quaternion of the state is zero; its norm must be 1")
        result = state.copy()
        result[layout.state.pose] = np.array(dual_quaternion.normalize(pose.tolist()))[stored]
        return result

    def _begin(self, state: FloatArray, stage: int) -> None:
        """Plan an episode, with the policy of the nominal maneuver as a guess."""
        if self._nominal is None:
            self._nominal = BoxDDP(self.maneuver).solve()
        self.plan = ManeuverPlan.make(self.maneuver, state, stage, self._nominal)
        self._work, self._next_stage, self.fallbacks = None, stage, 0

    def _window(self, plan: ManeuverPlan, stage: int) -> ShootingWorkspace:
        """Prepare the problem that starts at a stage.

        Its reference is the last solution, if that is one stage old, then the plan beyond its end.
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
            work.update.K[:kept] = last.update.K[1:]
        solution = plan.solution
        rest = slice(stage + kept - plan.first_stage, end - plan.first_stage)
        work.current.states[kept:horizon] = solution.states[rest]
        work.current.controls[kept:] = solution.controls[rest]
        work.update.K[kept:] = solution.feedback_gains[rest]
        if end < self.maneuver.horizon:
            self._model_state[0] = solution.states[rest.stop]
            self._model_gradient[0] = plan.Vx[rest.stop]
            self._model_hessian[0] = plan.Vxx[rest.stop]
        return work

    def _workspace(self, horizon: int, *, ends_early: bool) -> ShootingWorkspace:
        """Return the last workspace if it fits; only near the end of the episode it does not."""
        if self._work is not None:
            problem = self._work.problem
            assert isinstance(problem, WindowProblem)
            if (problem.horizon, problem.ends_early) == (horizon, ends_early):
                return self._work
        model = (self._model_state, self._model_gradient, self._model_hessian) if ends_early else ()
        return ShootingWorkspace(WindowProblem(self.maneuver, horizon, model), second_order=False)

    def _optimize(self, work: ShootingWorkspace, state: FloatArray, scale: float) -> bool:
        """Follow the reference from a state and improve it; return whether the rollout is finite."""
        work.trial.states[0] = state
        if not np.isfinite(work.try_step(0.0)):
            return False
        work.accept()
        work.trial.states[0] = state
        for _ in range(self.iterations):
            work.differentiate()
            outcome = work.backward_pass(0.0)
            if not outcome.completed or outcome.predicted_reduction(1.0) <= WORTHWHILE * scale:
                break
            if line_search(work, outcome) == 0.0:
                break
        return True


def _planned_control(plan: ManeuverPlan, state: FloatArray, stage: int) -> FloatArray:
    """Control of the plan's feedback policy, or of the plan alone where that is not finite."""
    index = stage - plan.first_stage
    with np.errstate(over="ignore", invalid="ignore"):
        control = plan.policy(state, index)
    return control if np.isfinite(control).all() else plan.solution.controls[index].copy()
