"""The public interface documents itself: every public function, its arguments, results and errors."""

import inspect
import re

import numpy as np
import pytest

import dq_space_arm_env
import experts
from dq_space_arm_env.scene import StateLayout

ARRAY_HINTS = ("ArrayLike", "NDArray", "FloatArray", "Array")


def public_functions():
    for package in (dq_space_arm_env, experts):
        for name in package.__all__:
            member = getattr(package, name)
            if inspect.isclass(member):
                yield f"{name}", member
                for attribute, function in vars(member).items():
                    own = getattr(function, "__func__", function)
                    if not attribute.startswith("_") and inspect.isfunction(own):
                        yield f"{name}.{attribute}", own
            elif callable(member):
                yield name, member


FUNCTIONS = dict(public_functions())


@pytest.mark.parametrize("name", FUNCTIONS)
def test_everything_public_has_a_docstring(name):
    assert inspect.getdoc(FUNCTIONS[name])


@pytest.mark.parametrize("name", [name for name, member in FUNCTIONS.items() if inspect.isfunction(member)])
def test_arguments_with_shapes_and_results_are_described(name):
    text, signature = inspect.getdoc(FUNCTIONS[name]), inspect.signature(FUNCTIONS[name])
    for parameter in signature.parameters.values():
        if parameter.name in ("self", "cls"):
            continue
        found = re.search(rf"^ *\**{parameter.name}:", text, re.MULTILINE)
        assert found, f"{name} does not describe {parameter.name}"
        if any(hint in str(parameter.annotation) for hint in ARRAY_HINTS):
            assert "shape" in text[found.start() : found.start() + 250], f"{name}: {parameter.name}"
    assert signature.return_annotation in (None, "None", inspect.Signature.empty) or "Returns:" in text


def test_functions_take_a_scene_by_its_name_too():
    functions = {name: member for name, member in FUNCTIONS.items() if inspect.isfunction(member)}
    takers = {
        name: functions[name]
        for name in functions.keys() & {*dq_space_arm_env.__all__}
        if "scene" in inspect.signature(functions[name]).parameters
    }
    for name, taker in takers.items():
        assert "Scene | str | Path" in str(inspect.signature(taker).parameters["scene"].annotation), name
    scene = dq_space_arm_env.load_scene("no-wrist")
    layout = StateLayout.of(scene)
    x, u = layout.initial_state, np.zeros(layout.n_u)
    for name in ("scene_to_urdf", "scene_to_mjcf"):
        assert takers[name]("no-wrist") == takers[name](scene)
    q, v = dq_space_arm_env.to_pinocchio("no-wrist", x)
    np.testing.assert_allclose(dq_space_arm_env.from_pinocchio("no-wrist", q, v), x, rtol=0, atol=1e-15)
    assert not dq_space_arm_env.generalized_forces("no-wrist", x, u).any()
    assert dq_space_arm_env.casadi_dynamics("no-wrist").scene == scene
