"""What a model gets wrong, found in flight: another load, springs and dampers that the scene does not have.

The innovation is the difference between the velocities that are measured and those that the model predicts
from the last measurement and input. Where its mean over some stages stands out of its scatter
(`MismatchDetector`), numbers of the scene are wrong. Joint stiffness and damping, and mass and inertia of the
load, then become parameters of the model, which an iterated extended Kalman filter estimates (Bell & Cathey,
IEEE Transactions on Automatic Control 38, 1993; `Identification`). Unlike a force that is held, they predict
how the mismatch changes along the maneuver.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dq_space_arm_env.environment.disturbances import load_numbers
from dq_space_arm_env.scene.bodies import freedoms
from experts.ddp.shooting import ShootingWorkspace
from experts.ddp.solution import Solution
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray

FORGETTING = 0.02
"""Weight of the last innovation in means."""
CERTAIN = 4.0
"""Mean of the innovations, or of their products with the last ones, that counts as a mismatch, in standard
deviations of such means of independent ones."""
NEGLIGIBLE = 1e-2
"""Size of innovations that do not count, relative to what the inputs can do in a stage."""
LARGEST = 10.0
"""Largest innovation, relative to what the inputs can do to any velocity: more is a wild measurement."""
LEAST_COUNT = 10
"""Innovations before which nothing is certain."""
GATE = 5.0
"""An innovation of more standard deviations is an outlier: a push is no property of the model."""
OUTLIER_GROWTH = 4.0
"""Growth of the scatter after an outlier: where all are, the scatter is larger than was thought."""
PASSES, CLOSE_ENOUGH = 4, 1e-3
"""Most linearizations of an update, and the change, in prior deviations, that ends it."""
WANDERING = 1e-3
"""Growth of the standard deviations per stage, relative to the prior ones."""
ROUGHNESS = 0.1
"""Share of the first innovations that counts as scatter: the filter's model is linear."""
SETTLING = 0.05
"""Weight of the last residual in the scatter."""
LEAST_SCATTER, LARGEST_SCATTER = 1e-7, 1.0
"""Least and largest standard deviation of a velocity, rad/s, m/s."""
LEAST_SHARE = 0.1
"""Least mass or inertia, relative to the known one."""
FIRST_WAIT, WAITS = 10, 2
"""Stages of measurements before the first new plan, and the growth of this number from plan to plan."""
WORTH_A_PLAN = 0.05
"""Change of an estimate, in prior deviations, that asks for a new plan."""


class Doubtful(NamedTuple):
    """A number of a scene that may be wrong."""

    name: str  # its path
    deviation: float  # prior standard deviation, in its unit
    least: float  # least difference from what is known, in its unit


def doubtful_numbers(maneuver: ArmProblem) -> list[Doubtful]:
    """Stiffness and damping of the joints, mass and inertia of the load; none that a phase changes.

    A spring may take the joint's largest torque at 1 rad, 1 N m without a motor; a damper a tenth at 1 rad/s;
    a mass may be half as large again as the maneuver has been told, or as the scene has it.
    """
    scene, layout, found = maneuver.scene, maneuver.kernels.layout, []
    limits = layout.control_limit[layout.control.joint_torque]
    torques = dict(zip(layout.actuated_joints, map(float, limits), strict=True))
    largest = {link: torques.get(joint, 1.0) for joint, (link, _) in enumerate(freedoms(scene.links))}
    for index, torque in largest.items():
        found.append(Doubtful(f"links.{index}.stiffness", torque, -np.inf))
        found.append(Doubtful(f"links.{index}.damping", 0.1 * torque, -np.inf))
    told = dict(zip(layout.parameters.names, maneuver.parameters.rows.min(axis=0).tolist(), strict=True))
    for number in load_numbers(scene):
        value = told.get(number.name, number.nominal)
        least = (LEAST_SHARE - 1.0) * value if value >= 0.0 else -np.inf
        found.append(Doubtful(number.name, 0.5 * abs(value or number.nominal), least))
    staged = {layout.parameters.names[index] for index in layout.parameters.staged}
    return [number for number in found if number.name not in staged]


def velocity_entries(maneuver: ArmProblem) -> tuple[slice, slice]:
    """Entries of the velocities, base then joints, in state and tangent."""
    layout = maneuver.kernels.layout
    return (
        slice(layout.state.base_velocity.start, layout.state.joint_rates.stop),
        slice(layout.tangent.base_velocity.start, layout.tangent.joint_rates.stop),
    )


class MismatchDetector:
    """Watches the innovations of an episode.

    Those of a wrong model last, or change slowly; those of noise change sign, and pushes come alone.
    """

    def __init__(self, count: int) -> None:
        """Watch so many velocities."""
        self._mean, self._square, self._product, self._last, self._authority = np.zeros((5, count))
        self._seen, self._is_outlier = 0, False

    def observe(self, innovation: FloatArray, authority: FloatArray) -> None:
        """Take another innovation, rad/s, m/s, and what the inputs can do in a stage, shape (n_v,) each."""
        was_outlier = self._is_outlier
        self._is_outlier = not np.all(np.abs(innovation) <= LARGEST * authority.max())
        if self._is_outlier or was_outlier:
            return
        self._mean += FORGETTING * (innovation - self._mean)
        self._square += FORGETTING * (innovation**2 - self._square)
        self._product += FORGETTING * (innovation * self._last - self._product)
        self._last, self._authority = innovation, authority
        self._seen += 1

    @property
    def is_certain(self) -> bool:
        """Whether the model is wrong: mean or autocorrelation is too large for independent innovations."""
        if self._seen < LEAST_COUNT:
            return False
        kept = (1.0 - FORGETTING) ** self._seen
        # Variance of such an exponential mean, relative to that of an innovation.
        share = FORGETTING / (2.0 - FORGETTING) * (1.0 + kept) / (1.0 - kept)
        size, square, variance = np.abs(self._mean), self._square, self._variance
        stands_out = size > CERTAIN * np.sqrt(variance * (1.0 - kept) * share)
        lasts = self._product > CERTAIN * np.sqrt(share) * square
        counts = square > (NEGLIGIBLE * self._authority) ** 2 * (1.0 - kept)
        return bool(((stands_out | lasts) & counts).any())

    @property
    def _variance(self) -> FloatArray:
        """Half the mean square of the innovations' differences, whatever their slow changes."""
        return np.maximum(self._square - self._product, 0.0)

    @property
    def variance(self) -> FloatArray:
        """Scatter of the innovations, and a share of their size, squared, shape (n_v,)."""
        seen = max(1.0 - (1.0 - FORGETTING) ** self._seen, FORGETTING)  # the means began with zero
        return (self._variance + ROUGHNESS**2 * self._square) / seen


class Identification:
    """A maneuver whose doubtful numbers are parameters, and the filter that estimates them.

    Attributes:
        problem: The maneuver with the present estimates.
        estimates: Deviations of the doubtful numbers from what is known, shape (n,), units of the parameters.
    """

    def __init__(self, maneuver: ArmProblem) -> None:
        """Prepare a maneuver, which is compiled anew; what is known of its parameters is read from it."""
        doubtful, known = doubtful_numbers(maneuver), maneuver.kernels.parameters.names
        scene = maneuver.scene
        more = [number.name for number in doubtful if number.name not in known]
        scene = scene.replace(parameters=[*scene.parameters, *more])
        self.problem = ArmProblem(scene)
        names = self.problem.kernels.parameters.names
        self.names = tuple(number.name for number in doubtful)
        self._known = [names.index(name) for name in known]
        self._estimated = [names.index(name) for name in self.names]
        self._maneuver = maneuver
        self._shared = [(i, known.index(name)) for i, name in enumerate(self.names) if name in known]
        self._stored, self._rates = velocity_entries(maneuver)
        self.begin(np.zeros(self._stored.stop - self._stored.start))

    def begin(self, variance: FloatArray) -> None:
        """Know nothing but the scatter of the measured velocities, shape (n_v,)."""
        self.estimates, self._planned = np.zeros((2, len(self.names)))
        self._told: FloatArray | None = None
        self._doubt()
        self._covariance = np.diag(self._deviations**2)
        self._variance = np.maximum(variance, LEAST_SCATTER**2)
        self._waited, self._wait, self._is_outlier = 0, FIRST_WAIT, False
        self.tell()

    def _doubt(self) -> None:
        """Find how far off the numbers may be that the maneuver knows now."""
        doubtful = doubtful_numbers(self._maneuver)
        self._deviations = np.array([number.deviation for number in doubtful])
        self._least = np.array([number.least for number in doubtful])

    def tell(self) -> None:
        """Give the problem what is known of the maneuver, and the estimates.

        A number that the maneuver has been told anew is estimated anew.
        """
        rows, told = self.problem.parameters.rows, self._maneuver.parameters.rows
        before = told if self._told is None else self._told
        if not np.array_equal(told, before):
            self._doubt()
        for i, column in self._shared:
            if not np.array_equal(told[:, column], before[:, column]):
                self.estimates[i] = self._planned[i] = 0.0
                self._covariance[i, :] = self._covariance[:, i] = 0.0
                self._covariance[i, i] = self._deviations[i] ** 2
        self._told = told.copy()
        rows[:] = self.problem.parameters.nominal
        rows[:, self._known] = told
        rows[:, self._estimated] += self.estimates

    def converted(self, solution: Solution, stage: int) -> Solution:
        """Return a solution of the maneuver from a stage on as one of the problem."""
        rows = self.problem.parameters.rows[stage:].copy()
        rows[:, self._known] = solution.parameters
        return replace(solution, parameters=rows)

    def update(self, state: FloatArray, control: FloatArray, measured: FloatArray, stage: int) -> None:
        """Learn from a stage: a measured state (n_x,), a control (n_u,), and the state measured next.

        Nothing is learnt from an outlier, nor from what follows it.
        """
        row = self.problem.parameters.rows[stage].copy()
        known, prior, noise = row[self._estimated] - self.estimates, self._covariance, self._variance
        found = self.estimates
        for iteration in range(PASSES):
            landed, sensitivity = self._predict(state, control, row)  # x+, S
            spread = sensitivity @ prior @ sensitivity.T
            innovation = (measured - landed)[self._stored]
            if iteration == 0:
                was_outlier = self._is_outlier
                self._is_outlier = not np.all(np.abs(innovation) <= GATE * np.sqrt(np.diag(spread) + noise))
                if self._is_outlier or was_outlier:
                    self._variance = np.minimum(OUTLIER_GROWTH * noise, LARGEST_SCATTER**2)
                    return
            gain = np.linalg.solve(spread + np.diag(noise), sensitivity @ prior).T  # P S' (S P S' + R)^-1
            better = self.estimates + gain @ (innovation + sensitivity @ (found - self.estimates))
            better = np.maximum(better, self._least)
            change, found = better - found, better
            row[self._estimated] = known + found
            if (np.abs(change) <= CLOSE_ENOUGH * self._deviations).all():
                break
        self.estimates = found
        posterior = prior - gain @ sensitivity @ prior
        self._covariance = 0.5 * (posterior + posterior.T) + np.diag((WANDERING * self._deviations) ** 2)
        residual = innovation - sensitivity @ change
        self._variance = np.maximum(noise + SETTLING * (residual**2 - noise), LEAST_SCATTER**2)
        self._waited += 1
        self.tell()

    def _predict(
        self, state: FloatArray, control: FloatArray, row: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Next state with given parameters, and the derivatives of its velocities by the estimated ones."""
        kernels = self.problem.kernels
        by_parameters = kernels.linearize_parameters(state, control, p=row)
        return kernels.step(state, control, p=row), by_parameters[self._rates][:, self._estimated]

    @property
    def asks_for_plan(self) -> bool:
        """Whether the estimates have left those of the last plan, and it is time for another one."""
        moved = np.abs(self.estimates - self._planned) > WORTH_A_PLAN * self._deviations
        return self._waited >= self._wait and bool(moved.any())

    def note_plan(self) -> None:
        """Wait longer before the next plan, which starts from the present estimates."""
        self._planned, self._waited, self._wait = self.estimates.copy(), 0, WAITS * self._wait

    @property
    def values(self) -> dict[str, float]:
        """The doubtful numbers at the end of the maneuver, by their paths, units of the parameters."""
        last = self.problem.parameters.rows[-1, self._estimated]
        return dict(zip(self.names, map(float, last), strict=True))


class ModelWatch:
    """Compares each measurement with its prediction, and corrects the model where they differ for long.

    Attributes:
        corrects: Whether there is anything to learn.
        model: The maneuver itself, or the one with estimated numbers.
        identification: The latter; None while the former serves.
    """

    def __init__(self, maneuver: ArmProblem, *, corrects: bool) -> None:
        """Watch a maneuver, and correct its model if wanted and if there is anything to doubt."""
        self._maneuver = maneuver
        self._prepared: Identification | None = None
        self.corrects = corrects and bool(doubtful_numbers(maneuver))
        self.begin()

    def begin(self) -> None:
        """Trust the scene, as at the start of an episode."""
        self.model: ArmProblem = self._maneuver
        self.identification: Identification | None = None
        self._stored, self._rates = velocity_entries(self._maneuver)
        self._detector = MismatchDetector(self._stored.stop - self._stored.start)

    @np.errstate(over="ignore", invalid="ignore")  # wild measurements are outliers
    def learn(
        self, work: ShootingWorkspace, control: FloatArray, measured: FloatArray, stage: int
    ) -> Identification | None:
        """Learn from a stage whose solution is in a workspace, its control, (n_u,), and the state behind it.

        Returns the identification if it begins with this stage.
        """
        before, landed = work.current.states[:2]
        if self.identification is not None:
            self.identification.update(before, control, measured, stage)
            return None
        by_state, by_input = (abs(each[0][self._rates]) for each in (work.derivatives.A, work.derivatives.B))
        limits, layout = work.bounds[1][0], self._maneuver.kernels.layout
        on_the_way = [chain.control for chain in layout.chains for _ in chain.names]  # acts in its place
        authority = by_input @ limits + by_state[:, layout.tangent.drives] @ limits[on_the_way]
        self._detector.observe((measured - landed)[self._stored], authority)
        if not self._detector.is_certain:
            return None
        if self._prepared is None:
            self._prepared = Identification(self._maneuver)
        self._prepared.begin(self._detector.variance)
        self.identification, self.model = self._prepared, self._prepared.problem
        return self._prepared
