"""HTML text in which every value is escaped."""

from __future__ import annotations

from html import escape

from jaxfit.errors import one_line

__all__ = ["Html", "element", "joined"]

_WITHOUT_END = ("img", "meta")


class Html(str):
    """Text that is HTML already."""

    __slots__ = ()


def joined(*parts: object) -> Html:
    """Return the parts as one HTML text: HTML as it is, other values as escaped text, and nothing for None."""
    return Html("".join(part if isinstance(part, Html) else _text(part) for part in parts if part is not None))


def element(tag: str, *content: object, **attributes: object) -> Html:
    """Return an HTML element.

    Args:
        tag: name of the element.
        content: the content, as for `joined`.
        attributes: name → value; `_` becomes `-`, and a `_` at the end is dropped (`class_`). None leaves the
            attribute out.
    """
    named = {key.rstrip("_").replace("_", "-"): value for key, value in attributes.items() if value is not None}
    start = "".join(f' {key}="{_text(value)}"' for key, value in named.items())
    return Html(f"<{tag}{start}>" if tag in _WITHOUT_END else f"<{tag}{start}>{joined(*content)}</{tag}>")


def _text(value: object) -> str:
    """Return a value as escaped text; control characters other than line breaks become visible escapes."""
    return escape("\n".join(one_line(line) for line in str(value).split("\n")))
