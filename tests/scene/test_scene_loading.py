"""Loading: names, paths and scenes; every failure is one SceneError that says what would be right."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from dq_space_arm_env.scene import Scene, SceneError, list_scenes, load_scene, scenes_directory

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
        path.write_text(text, encoding="utf-8")
        return path

    return function


Write = Callable[[str], Path]


def test_by_name_path_and_scene(write: Write) -> None:
    assert load_scene("paper").name == "paper"
    path = write(MINIMAL)
    scene = load_scene(path)
    assert scene == load_scene(str(path)) == load_scene(scene)
    assert scene.base.mass == 100


def test_a_relative_path_needs_only_its_suffix(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(write(MINIMAL).parent)
    assert load_scene("mine.yaml").name == "box"


def test_the_shipped_scenes_lie_in_the_top_level_configs() -> None:
    assert scenes_directory() == Path(__file__).parents[2] / "configs" / "scenes"
    assert list_scenes() == sorted(list_scenes())
    assert "paper" in list_scenes()


def test_an_installed_package_uses_the_scenes_inside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed = tmp_path / "configs" / "scenes"
    installed.mkdir(parents=True)
    (installed / "box.yaml").write_text(MINIMAL)
    monkeypatch.setattr("importlib.resources.files", lambda package: tmp_path)
    assert list_scenes() == ["box"]
    assert load_scene("box").name == "box"


def test_neither_installed_nor_checkout_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.resources.files", lambda package: tmp_path)
    monkeypatch.setattr("dq_space_arm_env.scene.loading.__file__", str(tmp_path / "a" / "b" / "c.py"))
    with pytest.raises(SceneError, match="the scenes that ship with the package are missing"):
        scenes_directory()


def test_unknown_name() -> None:
    with pytest.raises(
        SceneError, match=r"no scene is named 'papre'; did you mean 'paper'\? The scenes are far, "
    ):
        load_scene("papre")
    with pytest.raises(
        SceneError, match=r"no scene is named 'zzz'; The scenes are .*paper.*ending in \.yaml"
    ):
        load_scene("zzz")


@pytest.mark.parametrize("source", [None, 3, [("name", "box")]])
def test_other_types_are_no_source(source: Any) -> None:
    with pytest.raises(
        SceneError, match="the name of a scene, the path of a YAML file, a mapping or a Scene"
    ):
        load_scene(source)


@pytest.mark.parametrize("name", list_scenes())
def test_a_mapping_of_json_values_is_a_scene(name: str) -> None:
    scene = load_scene(name)
    values = json.loads(json.dumps(scene.model_dump(mode="json", exclude_none=True)))
    assert load_scene(values) == scene


def test_a_wrong_mapping_is_refused_with_all_that_is_wrong() -> None:
    with pytest.raises(SceneError, match="scene 'box': 2 problems") as caught:
        load_scene({"name": "box"})
    assert "base" in str(caught.value)
    assert "target" in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="there is no such file"):
        load_scene(tmp_path / "nothing.yaml")
    with pytest.raises(SceneError, match="there is no such file"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "the file is empty"),
        ("# only a comment\n", "the file is empty"),
        ("- a\n- b\n", "must be a mapping .* not a list"),
        ("just words", "must be a mapping .* not a str"),
        (
            "name: box\nbase: [1, 2\ntarget: 3\n",
            "not valid YAML: line 3, column 7: while parsing a flow sequence",
        ),
        ("name: box\n\tbase: 1\n", "not valid YAML: line 2, column 1: .*"),
        ("name: box\nname: bax\n", "line 2, column 1: duplicate key 'name'"),
        ("name: box\nbase:\n  mass: 1\n  mass: 2\n", "line 4, column 3: duplicate key 'mass'"),
        ("{[1, 2]: 3}", "found unhashable key"),
        ("name: !!python/object:os.system x", "could not determine a constructor"),
        ("a: 1\n---\nb: 1\n", "expected a single document"),
        ("name: \x07", "not valid YAML: .*special characters are not allowed"),
    ],
)
def test_files_that_are_no_scene(write: Write, text: str, sentence: str) -> None:
    path = write(text)
    with pytest.raises(SceneError, match=sentence) as caught:
        load_scene(path)
    assert str(caught.value).startswith(str(path))


def test_a_file_that_is_not_text(tmp_path: Path) -> None:
    path = tmp_path / "binary.yaml"
    path.write_bytes(b"name: \xff\xfe")
    with pytest.raises(SceneError, match="must be a text file in UTF-8"):
        load_scene(path)


def test_an_unreadable_file_is_said(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: object, **kwargs: object) -> str:
        raise PermissionError(13, "Permission denied")

    path = write(MINIMAL)
    monkeypatch.setattr(Path, "read_text", refuse)
    with pytest.raises(SceneError, match="cannot be read: Permission denied"):
        load_scene(path)


def test_every_problem_has_its_line(write: Write) -> None:
    path = write("name: box\nbase: {mass: -1, inertia: [1, 1, 9]}\ntarget: {pse: {}}\n")
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    first, *lines = str(caught.value).split("\n")
    assert first == f"{path}: 4 problems"
    assert [line.split(" = ")[0].split(": ")[0] for line in lines] == [
        "  - base.mass",
        "  - base.inertia",
        "  - target.pose",
        "  - target.pse",
    ]
    assert "did you mean 'pose'?" in lines[3]


def test_a_scene_that_was_not_validated_is_refused() -> None:
    scene = load_scene("paper")
    with pytest.raises(SceneError, match="scene 'paper': 1 problem\n  - description = 3: must be text"):
        load_scene(scene.model_copy(update={"description": 3}))


class TestNumbersInYaml:
    """YAML 1.1 reads some numbers as text and some text as numbers; scenes follow YAML 1.2."""

    @pytest.mark.parametrize(
        ("text", "number"),
        [
            ("1e-3", 1e-3),
            ("1E+3", 1e3),
            ("1e3", 1e3),
            (".5", 0.5),
            ("5.", 5.0),
            ("+7", 7.0),
            ("10", 10.0),
            ("010", 10.0),
        ],
    )
    def test_numbers_as_everyone_writes_them(self, write: Write, text: str, number: float) -> None:
        assert load_scene(write(MINIMAL.replace("100", text))).base.mass == number

    @pytest.mark.parametrize(
        "text", ["1:30", "1_000", "0x10", "yes", "true", "~", ".nan", "-.inf", "'3'", "1e-3x"]
    )
    def test_what_is_no_number_is_refused(self, write: Write, text: str) -> None:
        with pytest.raises(SceneError, match=r"base\.mass = .*must be a finite number greater than 0"):
            load_scene(write(MINIMAL.replace("100", text)))

    def test_infinite_limits(self, write: Write) -> None:
        scene = load_scene(write(MINIMAL + "actuators: {base_force: {limit: .inf}}\n"))
        assert scene.actuators.base_force is not None
        assert scene.actuators.base_force.limit == (float("inf"),) * 3

    @pytest.mark.parametrize("text", ["no", "on", "1:30", "0x10", "box"])
    def test_words_are_words(self, write: Write, text: str) -> None:
        assert load_scene(write(MINIMAL.replace("box", text))).name == text

    def test_a_number_as_a_name_must_be_quoted(self, write: Write) -> None:
        with pytest.raises(SceneError, match="name = 3: must be text; quote it"):
            load_scene(write(MINIMAL.replace("box", "3")))
        assert load_scene(write(MINIMAL.replace("box", "'3'"))).name == "3"


def test_to_yaml_is_readable_by_any_yaml_reader(tmp_path: Path) -> None:
    scene = load_scene("paper").replace(name="1e-3", description="yes")
    path = tmp_path / "resolved.yaml"
    text = scene.to_yaml(path)
    assert path.read_text(encoding="utf-8") == text
    assert text.startswith("# SI units")
    data = yaml.safe_load(text)
    assert (data["name"], data["description"]) == ("1e-3", "yes")
    assert Scene.model_validate(data) == scene == load_scene(path)
