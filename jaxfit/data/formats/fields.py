"""Values of a JSON file with their addresses, so that every error names file, field and remedy."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import read_json_file


def _shown(value: Any) -> str:
    text = value if isinstance(value, str) else reprlib.repr(value) if isinstance(value, list | dict) else repr(value)
    text = f'"{text}"' if isinstance(value, str) else text
    return text if len(text) <= 40 else text[:37] + "..."


def _kind(value: Any) -> str:
    kinds = {dict: "an object", list: "a list", str: "text", bool: "true or false", type(None): "null"}
    return kinds.get(type(value), "a number")


@dataclass(frozen=True)
class Field:
    """A value with its address, such as ``annotations[3].keypoints``.

    Methods that check the value raise InputError, which names the file, the field and the value.
    """

    source: Path
    path: str
    value: Any

    def fail(self, problem: str, remedy: str = "write the file again with correct values") -> NoReturn:
        """Raise InputError about this field."""
        raise InputError(self.source, f"{self.path or 'the file'} {problem}", remedy)

    def _expect(self, kind: type | tuple[type, ...], name: str) -> Any:
        if not isinstance(self.value, kind) or (isinstance(self.value, bool) and kind is not bool):
            self.fail(f"must be {name}, not {_kind(self.value)} ({_shown(self.value)})")
        return self.value

    def __contains__(self, key: str) -> bool:
        return key in self._expect(dict, "an object")

    def __getitem__(self, key: str) -> Field:
        """Return the value of ``key``, or raise InputError where it is missing."""
        if key not in self:
            self.fail(f"lacks the key {key}", f"add {key}: see the description of the format")
        return Field(self.source, f"{self.path}.{key}" if self.path else key, self.value[key])

    def has(self, key: str) -> bool:
        """Return whether ``key`` exists and is not null."""
        return key in self and self.value[key] is not None

    def entries(self) -> Iterator[tuple[str, Field]]:
        """Yield the keys and values of an object."""
        for key in self._expect(dict, "an object"):
            yield key, self[key]

    def __iter__(self) -> Iterator[Field]:
        """Yield the entries of a list."""
        for i, value in enumerate(self._expect(list, "a list")):
            yield Field(self.source, f"{self.path}[{i}]", value)

    def __len__(self) -> int:
        """Return the number of entries of a list."""
        return len(self._expect(list, "a list"))

    def text(self) -> str:
        """Return the value as text."""
        return self._expect(str, "text")

    def integer(self, lowest: int = -(2**62), highest: int = 2**62) -> int:
        """Return the value as a whole number within bounds; 3.0 counts as 3."""
        value = self._expect((int, float), "a whole number")
        if value != value or value in (math.inf, -math.inf) or value != int(value):
            self.fail(f"must be a whole number, not {_shown(value)}")
        if not lowest <= value <= highest:
            self.fail(f"is {_shown(value)}, outside {lowest} to {highest}")
        return int(value)

    def number(self, lowest: float, highest: float, remedy: str) -> float:
        """Return the value as a number within bounds."""
        value = self._expect((int, float), "a number")
        if not lowest <= value <= highest:  # also rejects NaN
            self.fail(f"is {_shown(value)}, outside {lowest:g} to {highest:g}", remedy)
        return float(value)


def read_json(path: Path) -> Field:
    """Return the content of a JSON file.

    Raises:
        InputError: as `read_json_file`.
    """
    return Field(path, "", read_json_file(path))
