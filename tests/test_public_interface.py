"""The public interface documents itself: every public function, its arguments, results and errors."""

import inspect
import re

import pytest

import dq_space_arm_env
import experts

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
