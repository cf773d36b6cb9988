"""How a mistake in a scene becomes a sentence: field path, value, and what would be right.

Every model of the scene derives from `Model`, which rewrites pydantic's errors on their way out. Checks of
our own raise `problem(...)` for the field at hand, `raise_problems(...)` when several fields are wrong at
once.
"""

import difflib
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, NamedTuple, NoReturn, Self

from pydantic import BaseModel, ConfigDict, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

_KIND = "scene_problem"
_LONGEST_SHOWN_VALUE = 120


class SceneError(ValueError):
    """A scene cannot be used; the message gives for every problem field, value, and what would be right."""


class Problem(NamedTuple):
    """One mistake.

    Attributes:
        location: Keys and indices that lead to the field, from the model that raises.
        value: The offending value.
        sentence: What would be right.
    """

    location: tuple[str | int, ...]
    value: object
    sentence: str


def problem(sentence: str) -> PydanticCustomError:
    """Build the error a field validator raises.

    Args:
        sentence: What would be right; path and value are added on the way out.

    Returns:
        The exception to raise.
    """
    return PydanticCustomError(_KIND, "{sentence}", {"sentence": sentence})


def raise_problems(problems: Iterable[Problem]) -> None:
    """Raise all problems in one `ValidationError`; do nothing when there are none.

    Args:
        problems: The mistakes found.

    Raises:
        ValidationError: If there is at least one problem.
    """
    errors = [
        InitErrorDetails(type=problem(sentence), loc=location, input=value)
        for location, value, sentence in problems
    ]
    if errors:
        raise ValidationError.from_exception_data("scene", errors)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Suggest the closest known word.

    Args:
        word: What was written.
        known: The words that would have been right.

    Returns:
        "did you mean 'mass'? " with a trailing blank, or an empty string when nothing is close.
    """
    close = difflib.get_close_matches(word, list(known), n=1)
    return f"did you mean {close[0]!r}? " if close else ""


def field_path(location: Iterable[str | int]) -> str:
    """Write a location as a reader of the YAML file would.

    Args:
        location: Keys and indices, outermost first.

    Returns:
        For example "links[1].joint.rotation"; "scene" for the whole file.
    """
    path = ""
    for part in location:
        path += f"[{part}]" if isinstance(part, int) else f".{part}" if path else part
    return path or "scene"


class Model(BaseModel):
    """Base of all scene models: immutable, hashable, unknown keys refused, errors in plain sentences."""

    # Instances are validated again: `model_copy(update=...)` does not validate what it makes.
    model_config = ConfigDict(extra="forbid", frozen=True, revalidate_instances="always")

    # Keys that a model's own "before" validator turns into fields.
    _other_keys: ClassVar[tuple[str, ...]] = ()

    @model_validator(mode="wrap")
    @classmethod
    def _explain(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        try:
            model = handler(data)
            raise_problems(model._problems())
            return model
        except ValidationError as error:
            _rethrow(cls, error)

    def _problems(self) -> Iterable[Problem]:
        """Problems that show only when all fields are valid, each by itself."""
        return ()


def _rethrow(model: type[Model], error: ValidationError) -> NoReturn:
    """Raise the same errors, worded as "path = value: what would be right"."""
    explained = []
    for detail in error.errors(include_url=False):
        location = detail["loc"]
        if detail["type"] == _KIND:
            sentence = detail["ctx"]["sentence"]
            # A nested model has already said what the field means; a check of our own has not yet.
            complete = "path" in detail["ctx"]
            shown = detail["ctx"].get("value", _shown(detail["input"]))
        else:
            sentence = _sentence(model, detail)
            complete = detail["type"] in ("missing", "extra_forbidden", "invalid_key")
            shown = "" if complete else _shown(detail["input"])
        if not complete and len(location) == 1:
            sentence += _meaning(model, location[0])
        context = {"path": field_path(location), "value": shown, "sentence": sentence}
        kind = PydanticCustomError(_KIND, "{path}{value}: {sentence}", context)
        explained.append(InitErrorDetails(type=kind, loc=location, input=detail["input"]))
    raise ValidationError.from_exception_data(model.__name__, explained) from None


def _shown(value: object) -> str:
    text = repr(value)
    return f" = {text if len(text) <= _LONGEST_SHOWN_VALUE else text[:_LONGEST_SHOWN_VALUE] + '...'}"


def _meaning(model: type[BaseModel], name: str | int) -> str:
    field = model.model_fields.get(str(name))
    return f" ({field.description})" if field and field.description else ""


def _sentence(model: type[Model], detail: ErrorDetails) -> str:
    """What would be right, for an error that pydantic found itself."""
    kind, location = detail["type"], detail["loc"]
    if kind == "missing":
        return f"missing; it is required{_meaning(model, location[-1])}"
    if kind == "extra_forbidden":
        known = [*model.model_fields, *model._other_keys]
        return f"unknown key; {did_you_mean(str(location[-1]), known)}Known keys here: {', '.join(known)}"
    known_sentence = _SENTENCES.get(kind)
    return known_sentence(detail.get("ctx", {})) if known_sentence else detail["msg"]


_SENTENCES: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "model_type": lambda context: "must be a mapping (key: value)",
    "dict_type": lambda context: "must be a mapping (key: value)",
    "invalid_key": lambda context: "keys must be text",
    "string_type": lambda context: "must be text; quote it if it looks like a number, a date or true/false",
    "bool_type": lambda context: "must be true or false",
    "string_too_short": lambda context: "must not be empty",
    "tuple_type": lambda context: "must be a list",
    "literal_error": lambda context: f"must be {context['expected']}",
}
