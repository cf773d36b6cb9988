"""The public interface documents itself: every public function, its arguments, results and errors."""

import inspect

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
def test_every_argument_is_described_and_arrays_have_shapes(name):
    function = FUNCTIONS[name]
    documentation = inspect.getdoc(function)
    for parameter in inspect.signature(function).parameters.values():
        if parameter.name in ("self", "cls"):
            continue
        line = next(
            (
                text
                for text in documentation.splitlines()
                if text.strip().lstrip("*").startswith(f"{parameter.name}:")
            ),
            None,
        )
        assert line is not None, f"{name} does not describe {parameter.name}"
        if any(hint in str(parameter.annotation) for hint in ARRAY_HINTS):
            start = documentation.index(line)
            assert "shape" in documentation[start : start + 250], (
                f"{name} gives no shape for {parameter.name}"
            )


@pytest.mark.parametrize("name", [name for name, member in FUNCTIONS.items() if inspect.isfunction(member)])
def test_results_are_described(name):
    function = FUNCTIONS[name]
    if inspect.signature(function).return_annotation not in (None, "None", inspect.Signature.empty):
        assert "Returns:" in inspect.getdoc(function)


def test_public_names_of_the_design_exist():
    for name in ("Scene", "load_scene", "list_scenes", "compile_scene", "DQSpaceArmEnv"):
        assert name in dir(dq_space_arm_env)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = dq_space_arm_env.nothing


def test_types_are_shipped():
    from importlib.resources import files

    assert files("dq_space_arm_env").joinpath("py.typed").is_file()
