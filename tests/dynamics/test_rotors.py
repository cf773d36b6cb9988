"""Rotors of geared motors against Pinocchio: each a body of its own, its joint bound to the one it drives."""

from dataclasses import replace
from functools import partial

import numpy as np
import pinocchio_twin as twin
import pytest

from dq_space_arm_env.algebra import poses, vectors
from dq_space_arm_env.dynamics import kinematics, minimal, newton_euler
from dq_space_arm_env.dynamics.articulated_body import ArticulatedBodies
from dq_space_arm_env.dynamics.forward import forward_dynamics, reaction_wrenches
from dq_space_arm_env.dynamics.kinematic_tree import Rotor
from dq_space_arm_env.dynamics.mass_matrix import MassMatrix, mass_matrix
from dq_space_arm_env.dynamics.minimal import Accelerations

pin = pytest.importorskip("pinocchio")

ZERO = (0.0, 0.0, 0.0)


def relative_error(actual, expected):
    expected = np.asarray(expected)
    return np.linalg.norm(np.asarray(actual, dtype=float) - expected) / np.linalg.norm(expected)


def random_rotor(rng, exact):
    gear = float(rng.choice([-1, 1]) * 10 ** rng.uniform(0.0, 2.0))
    return Rotor(float(rng.uniform(0.1, 2.0) / abs(gear)), gear, exact)


class Case:
    """A random robot whose joints have rotors (but one in four), and a motion of it."""

    def __init__(self, joints, seed, exact=True, branches=False):
        self.rng = rng = np.random.default_rng((joints, seed))
        tree = twin.random_tree(rng, joints, branches, wrist=False)
        rotors = [random_rotor(rng, exact) if rng.uniform() < 0.75 else None for _ in range(joints)]
        links = [replace(link, rotor=rotor) for link, rotor in zip(tree.links, rotors, strict=True)]
        self.tree = replace(tree, links=tuple(links), heaviest=int(rng.integers(joints + 1)))
        self.angles = rng.uniform(-3.0, 3.0, joints).tolist()
        self.angular, self.linear, self.force, self.torque = rng.normal(size=(4, 3)).tolist()
        self.rates, self.motors = rng.normal(size=(2, joints)).tolist()
        self.frames = minimal.link_frames(self.tree, self.angles)
        self.pose = twin.random_placement(rng).dual_quaternion
        self.acting = [(self.force, self.torque), *[(ZERO, ZERO)] * joints]
        self.tau = np.array([*self.force, *self.torque, *self.motors])

    @property
    def motion(self):
        return self.frames, self.angular, self.rates, self.acting, self.motors

    def accelerations(self, inertia):
        solved = forward_dynamics(self.tree, inertia(self.tree, self.frames), *self.motion)
        linear = vectors.subtract(solved.linear, vectors.cross(self.angular, self.linear))
        return np.array([*linear, *solved.angular, *solved.joints])


class Twin:
    """The robot with rotors as bodies: Pinocchio's larger model, and the map from the robot's velocities."""

    def __init__(self, case):
        self.model = model = twin.pinocchio_model(replace(case.tree, links=()))
        n, parent, places = len(case.tree.links), model.getJointId("base"), {}
        for i, link in enumerate(case.tree.links):
            placement = pin.SE3(np.array(link.joint.rotation), np.array(link.joint.position))
            if link.rotor is not None:  # added first: what a body carries stands together
                places[i] = joint = model.addJoint(parent, pin.JointModelRZ(), placement, f"rotor {i}")
                spinning = pin.Inertia(0.0, np.zeros(3), np.diag([0.0, 0.0, link.rotor.inertia]))
                model.appendBodyToJoint(joint, spinning, pin.SE3.Identity())
            parent = twin.add_link(model, parent, link, f"joint {i}")
        self.data, self.bound = model.createData(), np.zeros((model.nv, 6 + n))
        self.bound[:6, :6] = np.eye(6)
        self.q = np.zeros(model.nq)
        self.q[:7] = twin.configuration(case.pose, case.angles)[:7]
        for i, link in enumerate(case.tree.links):
            joint = model.joints[model.getJointId(f"joint {i}")]
            self.bound[joint.idx_v, 6 + i], self.q[joint.idx_q] = 1.0, case.angles[i]
            if i in places:
                joint = model.joints[places[i]]
                self.bound[joint.idx_v, 6 + i], self.q[joint.idx_q] = link.rotor.gear, 0.3 * i
        self.v = self.bound @ twin.velocity(case.angular, case.linear, case.rates)
        whole = pin.crba(model, self.data, self.q)
        whole = np.triu(whole) + np.triu(whole, 1).T
        self.mass = self.bound.T @ whole @ self.bound
        bias = pin.nonLinearEffects(model, self.data, self.q, self.v)
        self.accelerations = np.linalg.solve(self.mass, case.tau - self.bound.T @ bias)


@pytest.mark.parametrize("joints", [1, 2, 4, 7])
def test_rotors_with_their_exact_coupling_agree_with_bodies_on_joints_of_their_own(joints):
    """Both formulations from every root, the mass matrix, inverse dynamics, momentum, energy, reactions."""
    for seed in range(8):
        case = Case(joints, seed)
        other = Twin(case)
        expected = other.accelerations
        assert relative_error(case.accelerations(MassMatrix), expected) < 2e-13
        for root in range(joints + 1):
            found = case.accelerations(partial(ArticulatedBodies, root=root))
            assert relative_error(found, expected) < 1e-13
        order = [3, 4, 5, 0, 1, 2, *range(6, 6 + joints)]
        whole = np.array(mass_matrix(case.tree, case.frames), dtype=float)
        assert relative_error(whole, other.mass[np.ix_(order, order)]) < 8e-15

        moving = vectors.add(expected[:3], vectors.cross(case.angular, case.linear))
        given = Accelerations(expected[3:6], moving, expected[6:])
        needed = minimal.inverse_dynamics(case.tree, case.frames, case.angular, case.rates, given)
        assert relative_error([*needed.force, *needed.torque, *needed.joints], case.tau) < 1e-11
        reactions = reaction_wrenches(case.tree, *case.motion)
        pin.rnea(other.model, other.data, other.q, other.v, other.bound @ expected)
        forces = [other.data.f[other.model.getJointId(f"joint {i}")] for i in range(joints)]
        both = [[*force.linear, *force.angular] for force in forces]
        assert relative_error([[*f, *t] for f, t in reactions], both) < 1e-13

        twist = (*case.angular, *case.linear)
        velocities = kinematics.body_velocities(case.tree, case.frames, twist, case.rates)
        linear, angular, center = kinematics.momentum(case.tree, case.frames, velocities)
        centroidal = pin.computeCentroidalMomentum(other.model, other.data, other.q, other.v)
        attitude = np.array(poses.to_matrix(case.pose)[0])
        assert relative_error(attitude @ angular, centroidal.angular) < 2e-14
        assert relative_error(attitude @ linear, centroidal.linear) < 2e-14
        known = MassMatrix(case.tree, case.frames).momentum(case.angular, case.linear, case.rates)
        assert relative_error(known[1], angular) < 2e-14
        assert relative_error(MassMatrix(case.tree, case.frames).center, center) < 2e-15
        kinetic, _ = kinematics.energy(case.tree, case.angles, velocities)
        energy = pin.computeKineticEnergy(other.model, other.data, other.q, other.v)
        assert kinetic == pytest.approx(energy, rel=6e-15)


@pytest.mark.parametrize("joints", [1, 3, 6])
def test_rotors_as_plain_armature_agree_with_pinocchio(joints):
    for seed in range(8):
        case = Case(joints, seed, exact=False)
        model = twin.pinocchio_model(case.tree)
        rotors = [link.rotor or Rotor(0.0, 0.0, False) for link in case.tree.links]
        model.armature = np.array([*[0.0] * 6, *(rotor.gear**2 * rotor.inertia for rotor in rotors)])
        data, q = model.createData(), twin.configuration(case.pose, case.angles)
        v = twin.velocity(case.angular, case.linear, case.rates)
        expected = pin.aba(model, data, q, v, case.tau)
        assert relative_error(case.accelerations(MassMatrix), expected) < 2e-13
        for root in range(joints + 1):
            found = case.accelerations(partial(ArticulatedBodies, root=root))
            assert relative_error(found, expected) < 5e-14


def test_the_reaction_of_a_rotor_is_what_armature_leaves_out():
    """The motor turns link and rotor: without its coupling the base misses 1/N of the rotor's share."""
    case = Case(1, 3)
    still = replace(case.tree, links=(replace(case.tree.links[0], rotor=Rotor(1e-4, 100.0, True)),))
    plain = replace(still, links=(replace(still.links[0], rotor=Rotor(1e-4, 100.0, False)),))
    frames, rest = case.frames, Accelerations(ZERO, ZERO, [1.0])
    axis = np.array([row[2] for row in frames[0].rotation])
    torques = [
        np.array(minimal.inverse_dynamics(tree, frames, ZERO, [0.0], rest).torque) for tree in (still, plain)
    ]
    np.testing.assert_allclose(torques[0] - torques[1], 1e-4 * 100.0 * axis, rtol=0, atol=2e-15)


@pytest.mark.parametrize("exact", [True, False])
def test_rotors_of_arms_that_branch_are_alike_in_every_formulation(exact):
    for seed in range(8):
        case = Case(5, seed, exact, branches=True)
        expected = case.accelerations(MassMatrix)
        for root in range(6):
            found = case.accelerations(partial(ArticulatedBodies, root=root))
            assert relative_error(found, expected) < 3e-14
        moving = vectors.add(expected[:3], vectors.cross(case.angular, case.linear))
        given = Accelerations(expected[3:6], moving, expected[6:])
        needed = minimal.inverse_dynamics(case.tree, case.frames, case.angular, case.rates, given)
        assert relative_error([*needed.force, *needed.torque, *needed.joints], case.tau) < 1e-12


@pytest.mark.parametrize("branches", [False, True])
@pytest.mark.parametrize("exact", [True, False])
def test_the_papers_system_20_has_a_row_for_each_rotor(exact, branches):
    """Accelerations and reaction wrenches of the dual-quaternion Newton-Euler equations."""
    for seed in range(6):
        case = Case(4, seed, exact, branches)
        tree, twist = case.tree, (*case.angular, *case.linear)
        velocities = kinematics.body_velocities(tree, case.frames, twist, case.rates)
        duals = [
            (0.0, *v.angular, 0.0, *vectors.add(v.linear, vectors.cross(v.angular, body.center_of_mass)))
            for body, v in zip(tree.bodies, velocities, strict=True)
        ]
        state = newton_euler.PaperState(case.pose, case.angles, [], duals)
        wrench = (0.0, *case.force, 0.0, *case.torque)
        rates, found = newton_euler.paper_rates(tree, state, wrench, case.motors, [])
        bodies = [tuple(body) for body in np.reshape(rates[-8 * 5 :], (-1, 8))]
        frames = newton_euler.joint_frames(tree, case.angles, [])
        joints = newton_euler.along_joints(tree, frames, bodies)
        accelerations = [*bodies[0][5:8], *bodies[0][1:4], *joints]
        assert relative_error(accelerations, case.accelerations(MassMatrix)) < 7e-14
        expected = []
        for link, (force, torque) in zip(tree.links, reaction_wrenches(tree, *case.motion), strict=True):
            expected += [*force, *torque[:2]] if link.screw.turn else [*force[:2], *torque]
        assert relative_error(found, expected) < 5e-14
