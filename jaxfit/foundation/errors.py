"""The error for input that jaxfit cannot use; messages in one line, and counts in them."""

from __future__ import annotations

from collections.abc import Sequence

MAX_MESSAGE_CHARACTERS = 300
"""Longest message of an error or a warning on the command line."""
_PREFIX = "jaxfit: "
_SOURCE_CHARACTERS = 100
"""A message that is too long first shortens its source to this length, because the problem says more than a folder."""


class InputError(ValueError):
    """A file or an argument that jaxfit cannot use.

    The message names the file, the field and the remedy; the command line prints it without a traceback
    and exits with code 2. The message is one line of at most `MAX_MESSAGE_CHARACTERS` with the command line's prefix:
    control characters of the data are escaped, and long parts are shortened in the middle.
    """

    def __init__(self, source: object, problem: str, remedy: str = ""):
        self.source, self.problem, self.remedy = str(source), problem, remedy
        punctuation = len(": " + " ()" * bool(remedy))
        parts = [one_line(part) for part in (self.source, problem, remedy)]
        source_text, problem_text, remedy_text = _fitted(parts, MAX_MESSAGE_CHARACTERS - len(_PREFIX) - punctuation)
        super().__init__(f"{source_text}: {problem_text}" + (f" ({remedy_text})" if remedy else ""))

    def __reduce__(self) -> tuple:
        """Return how to build the error again, with the fields of its class, so that it can pass between processes."""
        return ValueError.__new__, (type(self), *self.args), vars(self)


def one_line(text: object) -> str:
    """Return a text without line breaks: control characters, and bytes that are not UTF-8, become escapes as `\\n`."""
    text = str(text)
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def counted(count: int, noun: str) -> str:
    """Return a count with its noun: `1 bird`, `2,000 birds`."""
    return f"{count:,} {noun}" + ("" if count == 1 else "s")


def shortened(text: str, longest: int) -> str:
    """Return a text of at most `longest` characters; a longer text loses characters in its middle."""
    if len(text) <= longest:
        return text
    kept = longest - 1
    return f"{text[: kept - kept // 2]}…{text[len(text) - kept // 2 :]}"


def _fitted(parts: Sequence[str], total: int) -> list[str]:
    """Shorten the source, then the longest parts, until all parts together have at most `total` characters."""
    if sum(map(len, parts)) > total:
        parts = [shortened(parts[0], _SOURCE_CHARACTERS), *parts[1:]]
    longest = total
    while sum(min(len(part), longest) for part in parts) > total:
        longest -= 1
    return [shortened(part, longest) for part in parts]
