"""Loading: names, paths and scenes; every failure is one SceneError that says what would be right."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest
import yaml

from dq_space_arm_env.scene import Scene, SceneError, list_scenes, load_scene

MINIMAL = """
name: box
base: {mass: 100, inertia: [10, 10, 10]}
target: {pose: {position: [1, 0, 0]}}
"""


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str], Path]:
    """Function that writes text to a scene file and returns its path."""

    def function(text: str) -> Path:
        path = tmp_path / "mine.yaml"
        path.write_text(text, encoding="utf-8", errors="surrogateescape")
        return path

    return function


Write = Callable[[str], Path]


def test_by_name_path_and_scene(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    assert load_scene("paper").name == "paper"
    path = write(MINIMAL)
    scene = load_scene(path)
    assert scene == load_scene(str(path)) == load_scene(scene)
    assert scene.base.mass == 100
    monkeypatch.chdir(path.parent)
    assert load_scene("mine.yaml") == scene


def test_installed_package_uses_scenes_inside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installed = tmp_path / "configs" / "scenes"
    installed.mkdir(parents=True)
    (installed / "box.yaml").write_text(MINIMAL)
    monkeypatch.setattr("importlib.resources.files", lambda package: tmp_path)
    assert list_scenes() == ["box"]
    assert load_scene("box").name == "box"


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("papre", r"no scene is named 'papre'; did you mean 'paper'\? The scenes are approach-corridor, "),
        (
            "iiwa.urdf",
            r"^iiwa\.urdf: this is a robot's file, .* `dq-space-arm scenes import FILE --tip LINK`",
        ),
        ("robots/iiwa.urdf.xacro", "makes a scene of it"),
        ("zzz", r"no scene is named 'zzz'; the scenes are .*paper.*ending in \.yaml"),
    ],
)
def test_unknown_name(name: str, sentence: str) -> None:
    with pytest.raises(SceneError, match=sentence):
        load_scene(name)


@pytest.mark.parametrize("source", [None, 3, [("name", "box")]])
def test_other_types_are_no_source(source: Any) -> None:
    with pytest.raises(SceneError, match="a name, the path of a YAML file, a mapping or a Scene"):
        load_scene(source)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="there is no such file"):
        load_scene(tmp_path / "nothing.yaml")
    with pytest.raises(SceneError, match="is a folder"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "the file is empty"),
        ("- a\n- b\n", "must be a mapping .* not a list"),
        ("base: [1, 2\ntarget: 3\n", "not valid YAML: line 2, column 7: while parsing a flow sequence"),
        ("name: box\n\tbase: 1\n", "not valid YAML: line 2, column 1: .*"),
        (
            "name: box\nname: bax\n",
            "line 2, column 1: the key 'name' stands twice, in lines 1 and 2",
        ),
        ("1: a\n1.0: b\n", "the key 1.0 stands twice, in lines 1 and 2: keep one"),
        ("{[1, 2]: 3}", "keys must be text"),
        ("name: !!python/object:os.system x", "could not determine a constructor"),
        ("a: 1\n---\nb: 1\n", "expected a single document"),
        ("name: \x07", "not valid YAML: .*special characters are not allowed"),
        ("name: \udcff", "must be a text file in UTF-8"),  # no UTF-8: the byte 0xff
    ],
)
def test_files_that_are_no_scene(write: Write, text: str, sentence: str) -> None:
    path = write(text)
    with pytest.raises(SceneError, match=sentence) as caught:
        load_scene(path)
    assert str(caught.value).startswith(str(path))


def test_an_unreadable_file_is_said(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: object, **kwargs: object) -> str:
        raise PermissionError(13, "Permission denied")

    path = write(MINIMAL)
    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(SceneError, match="cannot be read: Permission denied"):
        load_scene(path)


def test_every_problem_has_its_line(write: Write) -> None:
    path = write("name: box\nbase: {mass: -1, inertia: [1, 1, 9]}\ntarget: {pse: {}}\n")
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    first, *lines = str(caught.value).split("\n")
    assert first == f"{path}: 4 problems"
    fields = [line.removeprefix("  - ").split(" = ")[0].split(": ")[0] for line in lines]
    assert fields == ["base.mass", "base.inertia", "target.pose", "target.pse"]
    assert "did you mean 'pose'?" in lines[3]


def test_a_scene_that_was_not_validated_is_refused() -> None:
    scene = load_scene("paper")
    with pytest.raises(SceneError, match="scene 'paper': 1 problem\n  - description = 3: must be text"):
        load_scene(scene.model_copy(update={"description": 3}))


class TestNumbersInYaml:
    """YAML 1.1 reads some numbers as text and some text as numbers; scenes follow YAML 1.2."""

    NUMBERS: ClassVar = {"1e-3": 1e-3, "1E+3": 1e3, ".5": 0.5, "5.": 5.0, "+7": 7.0, "010": 10, "0x10": 16}

    @pytest.mark.parametrize(("text", "number"), NUMBERS.items())
    def test_numbers_as_everyone_writes_them(self, write: Write, text: str, number: float) -> None:
        assert load_scene(write(MINIMAL.replace("100", text))).base.mass == number

    @pytest.mark.parametrize("text", ["1:30", "yes", "true", "~", ".nan", "-.inf", "'3'", "1e-3x"])
    def test_what_is_no_number_is_refused(self, write: Write, text: str) -> None:
        with pytest.raises(SceneError, match=r"base\.mass = .*must be a finite number greater than 0"):
            load_scene(write(MINIMAL.replace("100", text)))

    @pytest.mark.parametrize("text", ["no", "on", "1:30", "box", "'3'"])
    def test_words_are_words(self, write: Write, text: str) -> None:
        assert load_scene(write(MINIMAL.replace("box", text))).name == text.strip("'")

    def test_a_number_as_a_name_must_be_quoted(self, write: Write) -> None:
        with pytest.raises(SceneError, match="name = 3: must be text; quote it"):
            load_scene(write(MINIMAL.replace("box", "3")))


def test_to_yaml_is_readable_by_any_yaml_reader(tmp_path: Path) -> None:
    scene = load_scene("paper").replace(name="1e-3", description="yes")
    path = tmp_path / "resolved.yaml"
    text = scene.to_yaml(path)
    assert path.read_text(encoding="utf-8") == text
    assert text.startswith("# SI units")
    data = yaml.safe_load(text)
    assert (data["name"], data["description"]) == ("1e-3", "yes")
    assert Scene.model_validate(data) == scene == load_scene(path)
