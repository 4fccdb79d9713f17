"""Mapping of keypoint names: from the names of a file to the names of a bird model.

A proposal compares words: `Beak`, `bill_tip` and `tipOfBill` are one keypoint, and so are `L_wing`, `wingL` and
`left wing tip`. A map from a file replaces the proposal.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple, cast

import numpy as np

from jaxfit.data.observations import MIN_KEYPOINTS, Observations
from jaxfit.foundation.errors import InputError

_SYNONYMS_OF = {
    "bill": "beak rostrum",
    "breast": "chest sternum",
    "wrist": "carpal carpus bend",
    "back": "mantle spine hind",
    "tailbase": "rump",
    "foot": "feet toe toes",
    "shin": "tarsus ankle",
    "throat": "chin gular",
    "crown": "vertex",
    "nape": "occiput hindneck",
    "forehead": "frons",
    "tip": "end point",
    "base": "root start",
    "middle": "mid centre center",
    "": "of the",
}
"""Word → the words that it replaces; the empty word does not count."""
_SYNONYMS = {synonym: word for word, synonyms in _SYNONYMS_OF.items() for synonym in synonyms.split()}
_PLAIN_WORDS = """
left right bill tip base tail wing head neck eye foot shin wrist back throat breast crown nape forehead top front upper
lower middle joint
"""
_WORDS = {*_SYNONYMS, *_PLAIN_WORDS.split()}
"""Words that a name without separators is split into, such as `tailbase`."""
_SIDES = {"l": "left", "r": "right", "lt": "left", "rt": "right", "left": "left", "right": "right"}
_ALIASES: Mapping[str, tuple[str, ...]] = {
    "bill_tip": ("bill",),
    "crown": ("head", "head top"),
    "forehead": ("front head",),
    "nape": ("neck", "back neck", "back head"),
    "throat": ("front neck", "front throat"),
    "back": ("back upper", "back middle"),
    "tail_base": ("tailbase",),
    "tail_tip": ("tail",),
    "wingtip": ("wing",),
    "wrist": ("wing wrist", "joint wrist"),
    "shin": ("joint shin",),
}
"""Keypoint of a model, without its side → other names for it, as sorted words; earlier names are preferred."""
_PARTS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


class NameMap(NamedTuple):
    """A map from the names of a file to the names of a model."""

    mapped: dict[str, str]
    """Name in the file → name in the model."""
    unmapped: tuple[str, ...]
    """Names in the file that no keypoint of the model has."""
    missing: tuple[str, ...]
    """Names of the model that no keypoint of the file has."""

    @property
    def changes_names(self) -> bool:
        """Whether any keypoint gets another name, or is left out."""
        return bool(self.unmapped) or any(old != new for old, new in self.mapped.items())


def propose_names(names: Sequence[str], model_names: Sequence[str]) -> NameMap:
    """Propose which keypoint of a model each keypoint of a file is.

    A keypoint of the model takes the name that agrees best: the same name, then the same words, then a synonym. Every
    keypoint of the model and of the file is used at most once.

    Args:
        names: names of the file.
        model_names: names of the model.
    """
    words = {name: _words(name) for name in names}
    mapped: dict[str, str] = {}
    ranked = {model: _alternatives(model) for model in model_names}
    for rank in range(2 + max(map(len, _ALIASES.values()))):
        for model, alternatives in ranked.items():
            if model in mapped.values():
                continue
            free = [name for name in names if name not in mapped]
            same = [
                name for name in free if (name == model if rank == 0 else words[name] in alternatives[rank - 1 : rank])
            ]
            if same:
                mapped[same[0]] = model
    return _name_map(mapped, names, model_names)


def names_in_model(names: Sequence[str], model_names: Sequence[str], source: object) -> NameMap:
    """Return the proposed map of the keypoints of a network, which may have none.

    Raises:
        InputError: fewer than `MIN_KEYPOINTS` keypoints are keypoints of the model.
    """
    found = propose_names(names, model_names)
    if names and len(found.mapped) < MIN_KEYPOINTS:
        problem = f"keypoints lack {', '.join(found.missing)}: fewer than {MIN_KEYPOINTS} are keypoints of the model"
        raise InputError(source, problem, "rename the keypoints as in the model, or choose another model")
    return found


def checked_map(
    given: Mapping[str, str | None], names: Sequence[str], model_names: Sequence[str], source: object
) -> NameMap:
    """Return the map that a user gives.

    Args:
        given: name in the file → name in the model, or None for a keypoint that is not used.
        names: names of the file. Names that `given` lacks are not used.
        model_names: names of the model.
        source: the file of the map, for messages.

    Raises:
        InputError: an unknown name, or two names of the file for one name of the model.
    """
    for old, new in given.items():
        if old not in names:
            raise InputError(source, f"maps {old}, which the file of keypoints lacks", f"known: {', '.join(names)}")
        if new is not None and new not in model_names:
            raise InputError(source, f"maps {old} to {new}, which the model lacks", f"known: {', '.join(model_names)}")
        first = next(other for other in given if given[other] == new)
        if new is not None and first != old:
            raise InputError(source, f"maps both {first} and {old} to {new}", "map one of the two to null")
    mapped = {old: new for old, new in given.items() if new is not None}
    return _name_map(mapped, names, model_names)


def map_keypoints(observations: Observations, names: NameMap, model_names: Sequence[str]) -> Observations:
    """Return the observations with the keypoints of a model; keypoints that the file lacks have confidence 0.

    A bird without any mapped keypoint in a frame keeps its box and mask there.
    """
    old_place = {name: k for k, name in enumerate(observations.keypoint_names)}
    new_place = {name: k for k, name in enumerate(model_names)}
    pairs = [(old_place[old], new_place[new]) for old, new in names.mapped.items()]
    old, new = ([pair[end] for pair in pairs] for end in (0, 1))

    def placed(array: np.ndarray) -> np.ndarray:
        shape = (*array.shape[:2], len(model_names), *array.shape[3:])
        values = np.zeros(shape, array.dtype)
        values[:, :, new] = array[:, :, old]
        return values

    moved = dict(pairs)
    return replace(
        observations,
        keypoint_names=tuple(model_names),
        keypoints_px=placed(observations.keypoints_px),
        confidence=placed(observations.confidence),
        occluded=placed(cast(np.ndarray, observations.occluded)),
        skeleton=tuple((moved[a], moved[b]) for a, b in observations.skeleton if a in moved and b in moved),
    )


def opposite_keypoints(names: Sequence[str]) -> tuple[int, ...]:
    """Return, for each keypoint, the position of the same keypoint on the other side of the bird.

    Names are compared by their words: `wingL` and `R_wing` are opposite. A keypoint without a side is its own
    opposite. The position is −1 for a keypoint with a side whose opposite is not named.

    Args:
        names: names of the keypoints.
    """
    words = [_words(name) for name in names]
    other = {"left": "right", "right": "left", "": ""}
    place = {key: k for k, key in reversed(list(enumerate(words)))}
    return tuple(k if not side else place.get((other[side], rest), -1) for k, (side, rest) in enumerate(words))


def _name_map(mapped: dict[str, str], names: Sequence[str], model_names: Sequence[str]) -> NameMap:
    return NameMap(
        {name: mapped[name] for name in names if name in mapped},
        tuple(name for name in names if name not in mapped),
        tuple(model for model in model_names if model not in mapped.values()),
    )


def _alternatives(model: str) -> list[tuple[str, str]]:
    """Return side and words of a keypoint of a model, and of its other names, in the order of preference."""
    side, model_words = _words(model)
    part = model.removeprefix("left_").removeprefix("right_")
    return [(side, model_words), *((side, words) for words in _ALIASES.get(part, ()))]


def _words(name: str) -> tuple[str, str]:
    """Return the side of a name (`left`, `right` or empty) and its other words, sorted, with one word per synonym."""
    words: list[str] = []
    for part in _PARTS.findall(name):
        words += _split(part.lower())
    sides = [_SIDES[word] for word in words if word in _SIDES]
    others = [_SYNONYMS.get(word, word) for word in words if word not in _SIDES]
    return (sides[0] if len(set(sides)) == 1 else ""), " ".join(sorted(word for word in others if word))


def _split(word: str) -> list[str]:
    """Split a word such as `lefttailbase` into known words; a side may be one letter at an end."""
    if word in _WORDS or word in _SIDES or len(word) > 40:
        return [word]
    known = _known_words(word)
    if known is None and word[0] in "lr" and (others := _known_words(word[1:])):
        known = [word[0], *others]
    if known is None and word[-1] in "lr" and (others := _known_words(word[:-1])):
        known = [*others, word[-1]]
    return known or [word]


@cache
def _known_words(text: str) -> list[str] | None:
    """Return a text as known words, with the fewest words; None if it is not made of known words."""
    if not text:
        return []
    ends = (end for end in range(len(text), 0, -1) if text[:end] in _WORDS)
    splits = ([text[:end], *others] for end in ends if (others := _known_words(text[end:])) is not None)
    return min(splits, key=len, default=None)
