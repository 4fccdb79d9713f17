"""JSON text of files and of metadata, with limits on size, depth and digits."""

from __future__ import annotations

import json
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

from jaxfit.errors import InputError
from jaxfit.limits import JSON_LEVELS, JSON_VALUES
from jaxfit.storage.reading import read_text

__all__ = ["parse_json", "read_json_file"]


def read_json_file(path: str | Path, most_bytes: int) -> Any:
    """Return the content of a JSON file as dicts, lists and plain values.

    Args:
        path: the file.
        most_bytes: size of the largest file that is accepted.

    Raises:
        InputError: as `read_text` and `parse_json`.
    """
    return parse_json(read_text(path, most_bytes, "a JSON file"), path)


def parse_json(text: str, source: object) -> Any:
    """Return the content of a JSON text as dicts, lists and plain values.

    The numbers NaN, Infinity and -Infinity are accepted, although JSON does not define them.

    Args:
        text: the JSON text.
        source: the file, for messages.

    Raises:
        InputError: the text is empty, is not JSON (the message names line and column), has more than `JSON_LEVELS`
            levels or `JSON_VALUES` values, holds a whole number that Python refuses to read (more than 4,300 digits),
            or an object that holds a key twice.
    """
    if not text.strip():
        raise InputError(source, "is empty", "write it again")
    # every value but the first follows one of these characters
    values = sum(map(text.count, ",[{"))
    if values > JSON_VALUES:
        raise InputError(source, f"holds about {values:,} values, more than {JSON_VALUES:,}", "split the file")
    try:
        content = json.loads(text, object_pairs_hook=partial(_object, source))
    except json.JSONDecodeError as error:
        # a truncated file has its error at its end, or at the string or list that is not closed
        cut = text.lstrip().startswith(("{", "[")) and not text.rstrip().endswith(("}", "]"))
        remedy = "the file ends midway: copy or write it again" if cut else "correct the file or write it again"
        problem = f"is not valid JSON at line {error.lineno}, column {error.colno}: {error.msg}"
        raise InputError(source, problem, remedy) from None
    except RecursionError:
        raise _too_deep(source) from None
    except InputError:
        raise
    except ValueError:
        raise InputError(source, "holds a number of too many digits", "write it again") from None
    level = [content] if isinstance(content, dict | list) else []
    for _ in range(JSON_LEVELS):
        values = (each.values() if isinstance(each, dict) else each for each in level)
        level = [value for part in values for value in part if type(value) in (dict, list)]
        if not level:
            return content
    raise _too_deep(source)


def _object(source: object, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise InputError(source, f'holds the key "{twice}" twice in one object', "remove one of the two")
    return content


def _too_deep(source: object) -> InputError:
    return InputError(source, f"is nested more than {JSON_LEVELS} levels deep", "write it again")
