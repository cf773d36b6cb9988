"""A receding-horizon expert (model predictive control): every step re-optimizes the next stages.

The whole maneuver is planned once per episode, from its start (`ManeuverPlan`). Every step then solves a
shorter problem from the given state, whose terminal cost is the plan's value function, to second order. The
previous solution, shifted by one stage and with its feedback, is so close to the new optimum that one
iteration is enough.

The iterations are Gauss-Newton's: their model is convex wherever noise and pushes take the state, even where
exact second derivatives have no minimum; near the plan the value function contains the curvature that they
neglect. Where the cheapest maneuver would end outside the tolerances, they become constraints of plan and
steps, with a share of them kept free for disturbances.
"""

from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike

from dq_space_arm_env import Scene
from dq_space_arm_env.algebra import dual_quaternion
from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.scene.parameters import TARGET
from dq_space_arm_env.scene.pose import PLANAR_POSE
from dq_space_arm_env.scene.start import unit_quaternions
from dq_space_arm_env.task.step_report import n_observations
from experts.ddp.shooting import ShootingWorkspace, line_search
from experts.ddp.solution import Solution
from experts.guesses.guided import RESERVE, GuidedDDP
from experts.identification import ModelWatch
from experts.maneuver_plan import ManeuverPlan
from experts.problems.arm_problem import ArmProblem, as_problem
from experts.problems.shooting_problem import FloatArray, check_array, check_whole, stage_bounds
from experts.problems.window_problem import WindowProblem

PREDICTIONS = 40
"""Predictions in an episode of where the plan's policy ends."""
WORTHWHILE = 1e-12
"""A smaller predicted reduction, relative to the plan's cost, is not tried: rounding would decide."""


ROUNDING = 1e-6
"""How far a quaternion of single precision may be off unit norm."""


class MeasurementError(ValueError):
    """A measurement that is no state: it has numbers that are not finite, or a zero quaternion."""


class RecedingHorizonExpert:
    """A policy `action = expert(observation_or_state)`; it owns its work arrays, so give each thread its own.

    Observations of `DQSpaceArm-v0` reveal the stage by the time left; the first one, and any with no less
    time left than the last, begins a new episode. States do not reveal it: calls are counted, and `reset`
    begins an episode. The two are told apart by their lengths: an observation has more entries, n_obs, than a
    state, n_x. Poses and rotations are normalized.

    A measurement that is no state, with numbers that are not finite or a zero quaternion, is an error where
    an episode begins. Within an episode the expert flies on: the state that its last solution predicts for
    the stage takes the place of the measurement, and `dropouts` counts it. The next good measurement corrects
    the prediction.

    Where joints have springs or dampers that the scene does not know, or the load has another mass, the
    measured velocities contradict the predicted ones for long. The expert then estimates these numbers and
    plans the rest of the episode anew, a few times (`experts.identification`).

    So it does where pushes or noise have led off the way to the target: forty times in an episode it predicts
    where the plan's policy ends. If that misses twice in a row, a new plan that reaches the target takes its
    place. Where measurements agree with the scene, nothing of this happens. A call that plans takes as long
    as the first one.

    The call that begins an episode plans it first, which takes a fraction of a second; so does `reset` with a
    state. What varies in the scene, such as the target, has its nominal value until `reset` or `inform` says
    otherwise: `expert.reset(observation, parameters=env.unwrapped.parameters)`.

    Attributes:
        maneuver: The scene as a shooting problem of N stages.
        horizon: Stages optimized at every step.
        iterations: Iterations per step.
        plan: Plan of the episode; None before it begins.
        control: Last control in N, N m, rad/s, shape (n_u,).
        fallbacks: Actions of this episode from the plan's feedback policy u = clip(u_k + K_k (x (-) x_k)), or
            from u_k alone where that is not finite, because no finite rollout started at the state.
        dropouts: Actions of this episode from a predicted state, because the measurement was none.
        replans: New plans of this episode, for better estimates or because it had left the way to the target.
        rejected_plans: Such plans that were none or did not lead to the target: the present one served on.
    """

    def __init__(
        self,
        scene: Scene | str | Path,
        horizon: int = 100,
        iterations: int = 1,
        *,
        identify: bool = True,
    ) -> None:
        """Prepare the expert; planning comes later.

        Args:
            scene: A scene, the name of a shipped one, or a path to a YAML file.
            horizon: Stages to optimize at every step, or the rest of the episode if that is shorter.
            iterations: Iterations per step; 0 only applies the plan's feedback.
            identify: Whether to estimate springs, dampers and the load where measurements contradict the
                scene. The first time that this happens compiles the scene with these numbers as parameters.

        Raises:
            TypeError: If it is a problem.
            SceneError: If the scene cannot be loaded.
            ValueError: If a setting is too small or no whole number, or the scene has no actuators or one
                without a limit.
        """
        check_whole("horizon", horizon, 1)
        check_whole("iterations", iterations, 0)
        if hasattr(scene, "kernel"):
            raise TypeError(
                f"RecedingHorizonExpert takes scenes only, no {type(scene).__name__}: give a scene, or solve "
                "the problem at every step, `BoxDDP(problem).solve(x, u_init)`"
            )
        self.maneuver = ArmProblem(scene)
        as_problem(self.maneuver)
        if not np.isfinite(self.maneuver.kernels.layout.control_limit).all():
            unlimited = int(np.argmax(~np.isfinite(self.maneuver.kernels.layout.control_limit)))
            name = self.maneuver.kernels.layout.control.names[unlimited]
            raise ValueError(f"{name} has no finite limit, but actions are fractions of limits: give it one")
        self.horizon, self.iterations = horizon, iterations
        self.plan: ManeuverPlan | None = None
        self.control: FloatArray = np.zeros(self.maneuver.n_controls)
        self.fallbacks = self.dropouts = self.replans = self.rejected_plans = 0
        self._next_stage, self._informed, self._strays = 0, False, False
        self._observation_size = n_observations(self.maneuver.scene)
        self._watch, self._measured = ModelWatch(self.maneuver, corrects=identify and iterations > 0), False
        self._planner: GuidedDDP | None = None
        self._work: ShootingWorkspace | None = None
        self._model_state = np.zeros((1, self.maneuver.n_states))
        self._model_gradient = np.zeros((1, self.maneuver.n_tangent))
        self._model_hessian = np.zeros((1, self.maneuver.n_tangent, self.maneuver.n_tangent))

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a RecedingHorizonExpert cannot be copied or pickled, its work arrays are its own: make another "
            "one of the same scene"
        )

    def reset(
        self, observation_or_state: ArrayLike | None = None, *, parameters: ArrayLike | None = None
    ) -> None:
        """Begin an episode.

        Args:
            observation_or_state: Its start, shape (n_obs,) or (n_x,), to plan now; None plans in the next
                call.
            parameters: What varies in the scene, shape (n_p,), or a row for each stage and the end, (N + 1,
                n_p), entries as in `kernels.parameters`; None for nominal ones.

        Raises:
            TypeError: If one is not of real numbers.
            ValueError: If one has another shape, the parameters are not finite or the other is no state; the
                episode goes on then.
            RuntimeError: If the maneuver cannot be simulated from there.
        """
        rows, start = self.maneuver.parameters.checked(parameters).copy(), None
        if observation_or_state is not None:
            given = self._checked(observation_or_state)
            stage = self._stage_of(given, 0)
            with self.maneuver.parameters.being(rows):
                start = self._state_of(given, stage), stage
        self.maneuver.parameters.set(rows)
        self._forget(0)
        self.plan = None
        if start is not None:
            self._begin(*start)

    @property
    def estimates(self) -> dict[str, float]:
        """Numbers of the scene as this episode shows them, by their paths; empty while it agrees."""
        found = self._watch.identification
        return {} if found is None else found.values

    def inform(self, parameters: ArrayLike) -> None:
        """Take other parameters in mid-flight, a new target or mass; the next call plans the rest anew.

        Of a target's quaternion q and -q, which cost differently, the one nearer to that before counts.

        Args:
            parameters: See `reset`; with a row for each stage, the motion of a target as it is measured and
                predicted now.

        Raises:
            TypeError: If they are not of real numbers.
            ValueError: If they have another shape or are not finite.
        """
        rows = self.maneuver.parameters.checked(parameters).copy()
        target = list(self.maneuver.kernels.parameters.indices(TARGET))
        if target:
            given = (self.maneuver.parameters.rows, rows)
            before, after = (self.maneuver.kernels.layout.target_with(each)[:, :4] for each in given)
            turned = (before * after).sum(axis=1) < 0.0
            rows[np.ix_(turned, target)] *= -1.0
        self.maneuver.parameters.set(rows)
        self._informed = True

    def __call__(self, observation_or_state: ArrayLike) -> FloatArray:
        """Choose an action.

        Args:
            observation_or_state: Observation, shape (n_obs,), or state, shape (n_x,).

        Returns:
            Inputs as fractions of their limits, in [-1, 1], shape (n_u,).

        Raises:
            TypeError: If it is not of real numbers.
            ValueError: If it has another shape, its time left exceeds the episode, or the episode begins and
                it is no state; nothing has changed then.
            RuntimeError: If the episode is over, or the maneuver cannot be simulated from its start.
        """
        given = self._checked(observation_or_state)
        stage = self._stage_of(given, self._next_stage)
        begins = self.plan is None or stage < self._next_stage
        try:
            state = self._state_of(given, stage)
            dropped = False
        except MeasurementError:
            if begins:
                raise
            state, dropped = self._predicted(stage), True
        if begins:
            self._begin(state, stage)
        else:
            self._keep_sign(state, stage)
            both_measured = self._measured and not dropped and stage == self._next_stage
            if self._watch.corrects and both_measured and self._work is not None:
                self._learn(state, stage)
            if self._informed:
                self._informed = not self._plan_anew(state, stage)
            elif self.iterations > 0:
                self._return_to_target(state, stage)
        assert self.plan is not None
        work = self._window(self.plan, stage)
        if self._optimize(work, state, self.plan.solution.cost):
            self._work, self.control = work, work.current.controls[0].copy()
        else:
            self._work, self.control = None, _planned_control(self.plan, state, stage)
            self.fallbacks += 1
        self.dropouts += dropped
        self._next_stage, self._measured = stage + 1, not dropped
        return self.maneuver.kernels.layout.to_action(self.control, self.maneuver.parameters.rows[stage])

    def _checked(self, observation_or_state: ArrayLike) -> FloatArray:
        """Return an observation or a state, or raise for another shape; its numbers may be wrong."""
        n_states, size = self.maneuver.n_states, self._observation_size
        given = real_array("observation_or_state", observation_or_state, np.float64)
        if given.shape not in ((n_states,), (size,)):
            raise ValueError(
                f"observation_or_state has shape {given.shape}; expected a state, ({n_states},), or "
                f"an observation, ({size},)"
            )
        return given

    def _stage_of(self, given: FloatArray, following: int) -> int:
        """Return the stage that an observation reveals, or else the following one."""
        maneuver, time_left = self.maneuver, float(given[-1])
        if len(given) == maneuver.n_states or not np.isfinite(time_left):
            if following == maneuver.horizon:
                raise RuntimeError(f"the episode's {maneuver.horizon} stages are over: call reset()")
            return following
        stage = maneuver.horizon - round(time_left / maneuver.time_step)
        if stage == maneuver.horizon:
            raise RuntimeError("the observation has no time left: the episode is over")
        if not 0 <= stage < maneuver.horizon:
            duration = maneuver.horizon * maneuver.time_step
            raise ValueError(
                f"observation[{len(given) - 1}], the time left, is {time_left} s; an episode of scene "
                f"{maneuver.scene.name!r} lasts {duration:g} s"
            )
        return stage

    def _state_of(self, given: FloatArray, stage: int) -> FloatArray:
        """Return the state at a stage; raise MeasurementError where there is none."""
        try:
            if len(given) == self.maneuver.n_states:
                check_array("state", given, given.shape)
                return self._plausible(self._of_unit_norm(given))
            check_array("observation", given, given.shape)
            with np.errstate(invalid="ignore", divide="ignore"):
                parameters = self.maneuver.parameters.rows[stage]
                state = self.maneuver.kernels.state_from_observation(given, p=parameters)
            check_array("the state behind the observation", state, state.shape)
            return self._plausible(state)
        except ValueError as error:
            raise MeasurementError(str(error)) from error

    def _predicted(self, stage: int) -> FloatArray:
        """Return the state that the last solution predicts for a stage, or else the plan's."""
        assert self.plan is not None
        if self._work is not None:
            states, ahead = self._work.current.states, stage - self._next_stage + 1
            if ahead <= self._work.problem.horizon:
                return np.array(states[ahead])
        return np.array(self.plan.solution.states[stage - self.plan.first_stage])

    def _keep_sign(self, state: FloatArray, stage: int) -> None:
        """Give the base's pose the sign that it had, in place: q and -q cost differently."""
        layout, pose = self.maneuver.kernels.layout, self.maneuver.kernels.layout.state.pose
        rotation = slice(pose.start, pose.start + (2 if layout.planar else 4))
        if state[rotation] @ self._predicted(stage)[rotation] < 0.0:
            state[pose] *= -1.0

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

    def _plausible(self, state: FloatArray) -> FloatArray:
        """Correct a measured state in place, and return it.

        Quaternions of spherical joints are normalized, but for their rounding. Previous controls were within
        bounds: rates would keep the next ones near them.
        """
        limits = self.maneuver.rate_limits
        if limits.states.size:
            lower, upper = (bound[:, limits.controls] for bound in stage_bounds(self.maneuver))
            state[limits.states] = np.clip(state[limits.states], lower.min(axis=0), upper.max(axis=0))
        for where in unit_quaternions(self.maneuver.scene):
            length = float(np.linalg.norm(state[where]))
            if length == 0.0:
                raise ValueError("the quaternion of a spherical joint is zero; its norm must be 1")
            if abs(length - 1.0) > ROUNDING:
                state[where] /= length
        return state

    def _begin(self, state: FloatArray, stage: int) -> None:
        """Plan an episode."""
        if self._planner is None:
            self._planner = GuidedDDP(self.maneuver, reserve=RESERVE)
        known: tuple[Solution, ...] = ()
        if stage > 0:
            with self.maneuver.parameters.being(None):
                known = self._planner.library
        rows = self.maneuver.parameters.rows.copy()
        try:
            self.plan = ManeuverPlan.make(self._planner, state, stage, known)
        finally:  # an interrupt may leave the nominal ones, with which the planner prepares itself
            self.maneuver.parameters.rows[:] = rows
        self._forget(stage)

    def _forget(self, stage: int) -> None:
        """Begin an episode at a stage with nothing but the scene."""
        self._work, self._next_stage, self._informed, self._strays = None, stage, False, False
        self.fallbacks = self.dropouts = self.replans = self.rejected_plans = 0
        self._watch.begin()

    def _learn(self, state: FloatArray, stage: int) -> None:
        """Correct the model where measurements contradict its predictions for long."""
        assert self._work is not None
        assert self.plan is not None
        begun = self._watch.learn(self._work, self.control, state, stage - 1)
        if begun is not None:
            needs_success = self.plan.maneuver is not self.maneuver
            maneuver = begun.problem.constrained(RESERVE) if needs_success else begun.problem
            solution = begun.converted(self.plan.solution, self.plan.first_stage)
            self.plan = replace(self.plan, solution=solution, maneuver=maneuver)
        found = self._watch.identification
        if found is not None and found.asks_for_plan:
            found.note_plan()
            self._plan_anew(state, stage)

    def _return_to_target(self, state: FloatArray, stage: int) -> None:
        """Plan anew where the plan reaches the target, but its policy would miss it from where it is now."""
        assert self.plan is not None
        if stage % max(self.maneuver.horizon // PREDICTIONS, 1) == 0:
            self._take_parameters(self.plan)
            strayed = self._strays
            self._strays = self.plan.reaches_target and not self.plan.reaches_target_from(state, stage)
            if strayed and self._strays:
                self._strays = not self._plan_anew(state, stage, must_reach=True)

    def _plan_anew(self, state: FloatArray, stage: int, *, must_reach: bool = False) -> bool:
        """Plan the rest of the episode; the present policy is a guess. Return whether the new plan serves."""
        assert self._planner is not None
        assert self.plan is not None
        if self._watch.identification is not None:
            self._watch.identification.tell()
        try:
            plan = ManeuverPlan.make(self._planner, state, stage, [self.plan.solution], self._watch.model)
        except RuntimeError:  # nothing can be simulated from there
            plan = None
        if plan is None or (must_reach and not plan.reaches_target):
            self.rejected_plans += 1
            return False
        self.plan, self._work = plan, None
        self.replans += 1
        return True

    def _take_parameters(self, plan: ManeuverPlan) -> None:
        """Give a plan's maneuver, where it has parameters of its own, those of the model."""
        if plan.maneuver is not self._watch.model:
            plan.maneuver.parameters.rows[:] = self._watch.model.parameters.rows

    def _window(self, plan: ManeuverPlan, stage: int) -> ShootingWorkspace:
        """Prepare the problem that starts at a stage.

        Its reference is the last solution, if that is one stage old, then the plan beyond its end.
        """
        self._take_parameters(plan)
        last = self._work if stage == self._next_stage else None
        horizon = min(self.horizon, self.maneuver.horizon - stage)
        end = stage + horizon
        work = self._workspace(plan.maneuver, horizon, ends_early=end < self.maneuver.horizon)
        assert isinstance(work.problem, WindowProblem)
        work.problem.begin_at(stage)
        work.bounds = stage_bounds(work.problem)
        first = stage - plan.first_stage
        work.problem.parameters.more[:] = plan.multipliers[first : first + horizon + 1]
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

    def _workspace(self, maneuver: ArmProblem, horizon: int, *, ends_early: bool) -> ShootingWorkspace:
        """Return the last workspace if it fits; only near the end of the episode it does not."""
        if self._work is not None:
            problem = self._work.problem
            assert isinstance(problem, WindowProblem)
            same_maneuver = problem.maneuver is maneuver
            if same_maneuver and (problem.horizon, problem.ends_early) == (horizon, ends_early):
                return self._work
        model = (self._model_state, self._model_gradient, self._model_hessian) if ends_early else ()
        return ShootingWorkspace(WindowProblem(maneuver, horizon, model), second_order=False)

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
