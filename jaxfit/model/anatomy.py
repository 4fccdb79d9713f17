"""Names and pairs of the joints and keypoints of the bird models.

The published models (avian-mesh, AVES) and the murre share one skeleton. In the rest pose the bird looks along +y
and +z points up, so the left side of the bird is −x. A joint has the name of its place in the anatomy of a bird: the
thigh lies inside the body, the visible joint half-way down the leg that bends backwards is the ankle, and the toes
begin at `foot`. The folded wings cross over the back, so `left_wingtip` of the published models lies a little to the
right of the midline.

Source: the order of the keypoints is that of Badger et al. 2020 (marcbadger/avian-mesh, `utils/constants.py`) and of
Wang et al. 2021 (the parts of CUB-200-2011; feet, shins and tail are split as in the annotations of that work). The
names of the joints are ours.
"""

from __future__ import annotations

from collections.abc import Sequence

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
    "left_wing_root",  # at the midline; moves the whole wing, but has no vertices of its own
    "left_shoulder",
    "left_elbow",
    "left_wrist",
    "neck_root",  # moves neck and head, but has no vertices of its own
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
"""The 20 keypoints of the murre. Hägerlind et al. label 20 points: the 18 of AVES and two points without names. We
choose the wrists for these two (carpal joints: the bend of the wing, at the breast side of a folded wing)."""

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
"""Pairs of murre keypoints that drawings connect by lines."""


def mirror_pairs(names: Sequence[str]) -> tuple[tuple[int, int], ...]:
    """Return (left, right) indices of the names that differ only in the prefix `left_` or `right_`."""
    index = {name: i for i, name in enumerate(names)}
    pairs = []
    for i, name in enumerate(names):
        if name.startswith("left_") and (right := index.get("right_" + name.removeprefix("left_"))) is not None:
            pairs.append((i, right))
    return tuple(pairs)


def other_side(name: str) -> str:
    """Return `right_foot` for `left_foot` and the reverse; return a name without a side unchanged."""
    for side, other in (("left_", "right_"), ("right_", "left_")):
        if name.startswith(side):
            return other + name.removeprefix(side)
    return name


def skeleton_pairs(keypoint_names: Sequence[str]) -> tuple[tuple[int, int], ...]:
    """Return the index pairs of `MURRE_SKELETON`; pairs with a keypoint that the model lacks are skipped."""
    index = {name: k for k, name in enumerate(keypoint_names)}
    return tuple((index[a], index[b]) for a, b in MURRE_SKELETON if a in index and b in index)
