"""Import avian-mesh, the cowbird model of Badger et al. 2020.

Source: Badger et al. 2020, *3D Bird Reconstruction* (github.com/marcbadger/avian-mesh).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jaxfit.errors import InputError
from jaxfit.limits import MODEL_JSON_BYTES
from jaxfit.model.anatomy import AVIAN_MESH_KEYPOINTS
from jaxfit.model.bird import Bird
from jaxfit.model.importers.published_bird import build_bird, read_prior
from jaxfit.model.importers.torch_file import read_tensors
from jaxfit.storage.json_file import read_json_file

__all__ = ["PRIOR_KEYS", "import_avian_mesh", "read_model_json"]

PRIOR_KEYS = ("p_m", "p_cov", "b_m", "b_cov")
"""Tensors of `pose_bone_prior.pth`: mean and covariance of the pose, then of the bone lengths."""


def import_avian_mesh(json_path: Path | str, prior_path: Path | str | None = None) -> Bird:
    """Import the cowbird model: 3932 vertices, 25 joints, 12 keypoints, no shape directions.

    Args:
        json_path: `bird_eccv.json`, the mesh, in model units.
        prior_path: `pose_bone_prior.pth`, the Gaussian priors of pose (radians) and bone length. This file is
            required, because a fit without a pose prior gives poor results.

    Raises:
        InputError: a file is missing or damaged, a field is missing, or a field has a wrong shape or wrong numbers.
    """
    if prior_path is None:
        remedy = "give pose_bone_prior.pth too; it is published beside bird_eccv.json"
        raise InputError(json_path, "the prior of pose and bone lengths is missing", remedy)
    mesh = read_model_json(json_path)
    prior = read_prior(read_tensors(prior_path), PRIOR_KEYS, prior_path)
    return build_bird("avian-mesh", mesh, prior, AVIAN_MESH_KEYPOINTS, json_path)


def read_model_json(path: Path | str) -> dict[str, Any]:
    """Return the top-level object of a model's JSON file, with its values as parsed.

    Raises:
        InputError: the file is missing, too large, not JSON (the message names line and column), or does not
            contain an object.
    """
    path = Path(path)
    content = read_json_file(path, MODEL_JSON_BYTES)
    if not isinstance(content, dict):
        raise InputError(path, "not a JSON object", "expected bird_eccv.json")
    return content
