"""Named body poses of the common guillemot (common murre), *Uria aalge*, the bird that comes with jaxfit.

The mesh, the joints and the prior of this bird are in `murre.npz` (`jaxfit.model.files.load_murre`). On the ground, the
tarsi (on which murres rest) and the toes lie flat on level ground, with the pitch of the posture about +x.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit.model.anatomy import JOINT_NAMES


class Posture(NamedTuple):
    """A body pose and the pitch of the bird."""

    body_pose: Float[np.ndarray, "bones 3"]
    """Axis-angle of every joint except the root, radians."""
    pitch_rad: float
    """Rotation of the whole bird about +x (bill upwards), radians; 0 is the rest pose."""


def _read_postures(path: Path) -> dict[str, Posture]:
    """Return the postures of a JSON file: name → pitch, and axis-angle of each joint that is not at rest, radians."""
    rest = [0.0, 0.0, 0.0]
    content = json.loads(path.read_text(encoding="utf-8"))
    return {
        name: Posture(np.array([turns.get(joint, rest) for joint in JOINT_NAMES[1:]]), turns["pitch"])
        for name, turns in content.items()
    }


POSTURES = _read_postures(Path(__file__).with_name("murre_postures.json"))
"""Name → posture of a murre on a ledge or in flight."""
