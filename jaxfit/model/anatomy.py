"""What the joints and keypoints of the published bird models are called.

Both models share one skeleton. In rest pose the bird looks along +y with +z up, so its left side is −x.
A joint is named by the place it turns about, in a bird's terms: the thigh lies inside the body, the joint
that shows half-way down the leg and bends backwards is the ankle, and `foot` is where the toes begin.
The folded wings cross over the back, which puts `left_wingtip` a little to the right of the midline.

Source: the keypoints' order is Badger et al. 2020 (marcbadger/avian-mesh, `utils/constants.py`) and
Wang et al. 2021 (the parts of CUB-200-2011, feet, shins and tail split as that work annotates them); the
joints' names are ours.
"""

from __future__ import annotations

from collections.abc import Sequence

__all__ = [
    "AVES_KEYPOINTS",
    "AVIAN_MESH_KEYPOINTS",
    "JOINT_NAMES",
    "MURRE_KEYPOINTS",
    "MURRE_SKELETON",
    "mirror_pairs",
    "other_side",
    "skeleton_pairs",
]

JOINT_NAMES = (
    "root",
    "lower_body",
    "tail",
    "upper_body",
    "chest",
    "left_hip",
    "left_knee",
    "left_ankle",
    "left_foot",
    "left_wing_root",  # at the midline; moves no vertex of its own, but the whole wing
    "left_shoulder",
    "left_elbow",
    "left_wrist",
    "neck_root",  # likewise for neck and head
    "neck",
    "head",
    "jaw",  # the lower bill
    "right_wing_root",
    "right_shoulder",
    "right_elbow",
    "right_wrist",
    "right_hip",
    "right_knee",
    "right_ankle",
    "right_foot",
)

AVIAN_MESH_KEYPOINTS = (
    "bill_tip",
    "left_eye",
    "right_eye",
    "neck",
    "nape",
    "left_wingtip",
    "right_wingtip",
    "left_foot",
    "right_foot",
    "tail_tip",
    "left_wrist",
    "right_wrist",
)

AVES_KEYPOINTS = (
    "left_eye",
    "right_eye",
    "forehead",
    "crown",
    "nape",
    "back",
    "throat",
    "breast",
    "bill_base",
    "bill_tip",
    "left_foot",
    "left_shin",
    "right_foot",
    "right_shin",
    "tail_base",
    "tail_tip",
    "left_wingtip",
    "right_wingtip",
)

MURRE_KEYPOINTS = (*AVES_KEYPOINTS, "left_wrist", "right_wrist")
"""The murre's 20. Hägerlind et al. label 20 points, AVES' 18 and two that they do not name; that these are the
wrists (carpal joints: the bend of the wing, at the breast side of the folded one) is our choice."""

MURRE_SKELETON = (
    ("bill_tip", "bill_base"),
    ("bill_base", "forehead"),
    ("forehead", "crown"),
    ("crown", "nape"),
    ("nape", "back"),
    ("back", "tail_base"),
    ("tail_base", "tail_tip"),
    ("bill_base", "throat"),
    ("throat", "breast"),
    ("bill_base", "left_eye"),
    ("bill_base", "right_eye"),
    ("left_eye", "crown"),
    ("right_eye", "crown"),
    ("back", "left_wrist"),
    ("back", "right_wrist"),
    ("left_wrist", "left_wingtip"),
    ("right_wrist", "right_wingtip"),
    ("breast", "left_shin"),
    ("breast", "right_shin"),
    ("left_shin", "left_foot"),
    ("right_shin", "right_foot"),
)
"""Pairs of the murre's keypoints that a picture joins by lines."""


def mirror_pairs(names: Sequence[str]) -> tuple[tuple[int, int], ...]:
    """(left, right) indices of the names that differ only in `left_` and `right_`."""
    index = {name: i for i, name in enumerate(names)}
    pairs = []
    for i, name in enumerate(names):
        if name.startswith("left_") and (right := index.get("right_" + name.removeprefix("left_"))) is not None:
            pairs.append((i, right))
    return tuple(pairs)


def other_side(name: str) -> str:
    """`right_foot` for `left_foot` and the reverse; a name without a side is its own."""
    for side, other in (("left_", "right_"), ("right_", "left_")):
        if name.startswith(side):
            return other + name.removeprefix(side)
    return name


def skeleton_pairs(keypoint_names: Sequence[str]) -> tuple[tuple[int, int], ...]:
    """Indices of the keypoints that `MURRE_SKELETON` joins, of those that a model has."""
    index = {name: k for k, name in enumerate(keypoint_names)}
    return tuple((index[a], index[b]) for a, b in MURRE_SKELETON if a in index and b in index)
