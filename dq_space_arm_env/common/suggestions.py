"""Suggestions for misspelled words."""

from collections.abc import Iterable

_LONGEST = 60  # characters of a word that was meant to be another


def did_you_mean(word: str, known: Iterable[str], then: str = "") -> str:
    """Suggest the closest known word: "did you mean 'mass'? ", or nothing; then a sentence, or its rest."""
    from difflib import get_close_matches  # costs the command line a millisecond

    close = get_close_matches(word[:_LONGEST], list(known), n=1)
    return f"did you mean {close[0]!r}? {then[:1].upper()}{then[1:]}" if close else then
