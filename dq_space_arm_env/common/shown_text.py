"""Text from others, made fit to be shown: cut off, without control characters, without markup."""

import re
import unicodedata
from itertools import islice
from reprlib import Repr
from typing import Any

LONGEST = 120
"""Characters of a value in a message."""
_LARGEST_BITS = 1023  # integers up to there are written with all digits
_KEY = re.compile(r"[\w.]{1,60}", re.ASCII)
_PLAIN = re.compile(r"[\w .,:;()+/%°=-]*")


def shortened(value: object, longest: int = LONGEST) -> str:
    """Write a value for a message, cut off with "..."; a huge value takes no longer than a small one."""
    text = _Cut(longest).repr(value)
    return text if len(text) <= longest else f"{text[:longest]}..."


def yaml_like(value: object) -> str:
    """Write a value as `shortened` does, but mappings, null, true and false as YAML has them."""
    text = _YAMLCut(LONGEST).repr(value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


class _Cut(Repr):
    """Writes values until enough characters are written."""

    def __init__(self, longest: int) -> None:
        super().__init__()
        self.maxlevel = 8
        self.maxstring = self.maxother = 2 * longest
        self.maxlist = self.maxtuple = self.maxdict = self.maxset = self.maxfrozenset = longest
        self._left = 8 * longest  # inner text counts once per level

    def repr1(self, x: Any, level: int) -> str:
        if self._left <= 0:
            return "..."
        text = super().repr1(x[: self.maxstring] if isinstance(x, bytes) else x, level)
        self._left -= len(text)
        return text

    def repr_int(self, x: int, level: int) -> str:
        return repr(x) if x.bit_length() <= _LARGEST_BITS else f"<an integer of {x.bit_length():,} bits>"

    def repr_str(self, x: str, level: int) -> str:
        return repr(x[: self.maxstring])


class _YAMLCut(_Cut):
    def repr1(self, x: Any, level: int) -> str:
        if hasattr(type(x), "model_fields"):  # a model, by what was given of it
            x = {name: getattr(x, name) for name in type(x).model_fields if name in x.model_fields_set}
        return super().repr1(x, level)

    def repr_NoneType(self, x: None, level: int) -> str:
        return "null"

    def repr_bool(self, x: bool, level: int) -> str:
        return str(x).lower()

    def repr_dict(self, x: dict[Any, Any], level: int) -> str:
        if x and level <= 0:
            return "{...}"
        entries = []
        for key, value in islice(x.items(), self.maxdict):
            plain = isinstance(key, str) and _KEY.fullmatch(key)
            entries.append(f"{key if plain else self.repr1(key, level - 1)}: {self.repr1(value, level - 1)}")
        return f"{{{', '.join(entries)}{', ...' if len(x) > self.maxdict else ''}}}"


def printable(text: str) -> str:
    """Write control characters, except tabs and line feeds, as escapes, so that a terminal obeys none.

    Characters that turn the direction of text, invalid ones and other separators of lines become escapes too.
    """
    if text.isprintable():
        return text
    return "".join(_escaped(character) if is_control(character) else character for character in text)


def is_control(character: str) -> bool:
    """Tell whether a character is invisible and changes what is shown around it, or is no character."""
    if character in "\n\t" or character.isprintable():
        return False
    category = unicodedata.category(character)
    # Joiners are part of words and emoji; characters that this Python does not know yet are fine.
    return (
        category in ("Cc", "Cs", "Zl", "Zp")
        or (category == "Cf" and character not in "\u200c\u200d\u00ad")
        or ord(character) & 0xFFFE == 0xFFFE
    )


def _escaped(character: str) -> str:
    return character.encode("unicode_escape", "backslashreplace").decode("ascii")


def markdown_text(text: str) -> str:
    """Write text so that Markdown and HTML show it as it is, on one line."""
    line = " ".join(printable(text).split())
    if _PLAIN.fullmatch(line):
        return line
    line = line.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"([\\`*\[\]|#!~$])", r"\\\1", line)
