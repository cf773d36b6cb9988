"""Mistakes in a scene as sentences: field path, value, and what would be right.

All models derive from `Model`, which rewrites pydantic's errors. Field validators raise `problem(...)`;
checks of several fields call `raise_problems(...)`.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, NamedTuple, NoReturn, Self, get_args

from pydantic import BaseModel, ConfigDict, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from dq_space_arm_env.common.shown_text import printable, yaml_like
from dq_space_arm_env.common.suggestions import did_you_mean

_KIND = "scene_problem"
_MOST_SHOWN = 20  # problems in one message
_LONGEST_KEY = 60  # characters


class SceneError(ValueError):
    """An unusable scene; the message gives field, value and the remedy for every problem."""


class Problem(NamedTuple):
    """One mistake."""

    location: tuple[str | int, ...]  # keys and indices, from the model that raises
    value: object
    sentence: str  # what would be right


def problem(sentence: str) -> PydanticCustomError:
    """Build the error that a field validator raises; its sentence says what would be right."""
    return PydanticCustomError(_KIND, "{sentence}", {"sentence": sentence})


def raise_problems(problems: Iterable[Problem]) -> None:
    """Raise all problems in one `ValidationError`; do nothing when there are none."""
    errors = [
        InitErrorDetails(type=problem(sentence), loc=location, input=value)
        for location, value, sentence in problems
    ]
    if errors:
        raise ValidationError.from_exception_data("scene", errors)


def field_path(location: Iterable[str | int]) -> str:
    """Write a location as "links[1].joint.rotation", or "scene" for the whole file."""
    path = ""
    for part in location:
        # Unknown keys are in the words of whoever wrote the file.
        key = part if isinstance(part, int) else printable(part[:_LONGEST_KEY])
        path += f"[{key}]" if isinstance(key, int) else f".{key}" if path else key
    return path or "scene"


def problem_list(origin: str, error: ValidationError | None, *others: str) -> str:
    """List other problems and those of a model, a line each."""
    found = () if error is None else error.errors(include_url=False)
    problems = [*others, *(detail["msg"] for detail in found)]
    count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
    more = len(problems) - _MOST_SHOWN
    rest = [f"and {more} more"] if more > 0 else []
    return "\n  - ".join([f"{origin}: {count}", *problems[:_MOST_SHOWN], *rest])


class Model(BaseModel):
    """Base of all models: immutable, hashable, no unknown keys, errors in plain sentences."""

    # Instances are validated again: `model_copy(update=...)` does not validate what it makes.
    model_config = ConfigDict(extra="forbid", frozen=True, revalidate_instances="always")

    # Keys that a model's own "before" validator turns into fields.
    _other_keys: ClassVar[tuple[str, ...]] = ()
    # Keys that are none here, and sentences that say what to give instead.
    _elsewhere: ClassVar[Mapping[str, str]] = {}
    # Names of the same in other models, by which it may be asked for here.
    _other_words: ClassVar[Mapping[str, str]] = {}

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
        """Problems between fields that are valid by themselves."""
        return ()


def _rethrow(model: type[Model], error: ValidationError) -> NoReturn:
    """Raise the same errors, worded as "path = value: what would be right"."""
    explained, found = [], error.errors(include_url=False)
    around = {each["loc"][:end] for each in found for end in range(len(each["loc"]))}
    for detail in found:
        if detail["type"] == "too_short" and detail["loc"] in around:
            continue  # without its wrong items, which are named
        location = _without_tag(model, detail["loc"])
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


def _without_tag(model: type[BaseModel], location: tuple[int | str, ...]) -> tuple[int | str, ...]:
    """A location without the tag that pydantic puts behind a union's field: it is no key of the file."""
    field = model.model_fields.get(str(location[0])) if len(location) > 1 else None
    if field is None or not isinstance(field.discriminator, str):
        return location
    named = [option.model_fields[field.discriminator] for option in get_args(field.annotation)]
    tags = {tag for each in named for tag in get_args(each.annotation)}
    return (location[0], *location[2:]) if location[1] in tags else location


def _shown(value: object) -> str:
    return f" = {yaml_like(value)}"


def _meaning(model: type[BaseModel], name: str | int) -> str:
    field = model.model_fields.get(str(name))
    return f" ({field.description})" if field and field.description else ""


def _sentence(model: type[Model], detail: ErrorDetails) -> str:
    """Word an error that pydantic found."""
    kind, location = detail["type"], detail["loc"]
    if kind == "missing":
        return f"missing; it is required{_meaning(model, location[-1])}"
    if kind == "extra_forbidden":
        known = [*model.model_fields, *model._other_keys]
        here = f"known keys here: {', '.join(known)}"
        word = str(location[-1])
        if word in model._elsewhere:
            return f"unknown key; {model._elsewhere[word]}"
        return f"unknown key; {did_you_mean(model._other_words.get(word, word), known, here)}"
    if kind == "model_type":
        needed = [name for name, field in model.model_fields.items() if field.is_required()]
        values = [yaml_like(detail["input"])] if len(needed) == 1 else ["..."] * len(needed)
        entries = [f"{name}: {value}" for name, value in zip(needed, values, strict=True)]
        return f"must be a mapping, as {{{', '.join(entries or ['key: value'])}}}"
    known_sentence = _SENTENCES.get(kind)
    return known_sentence(detail.get("ctx", {})) if known_sentence else detail["msg"]


_SENTENCES: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "dict_type": lambda context: "must be a mapping (key: value)",
    "invalid_key": lambda context: "keys must be text",
    "string_type": lambda context: "must be text; quote it if it looks like a number, a date or true/false",
    "string_too_short": lambda context: "must not be empty",
    "tuple_type": lambda context: "must be a list",
    "less_than_equal": lambda context: f"must be at most {context['le']:g}",
    "literal_error": lambda context: f"must be {context['expected']}",
}
