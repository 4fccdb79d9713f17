"""Import AVES, the multi-species model of Wang et al. 2021.

Source: Wang et al. 2021, *Birds of a Feather* (github.com/yufu-wang/aves).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxfit.errors import InputError
from jaxfit.model.anatomy import AVES_KEYPOINTS
from jaxfit.model.bird import Bird
from jaxfit.model.importers.avian_mesh import PRIOR_KEYS
from jaxfit.model.importers.published_bird import build_bird, read_numbers, read_prior
from jaxfit.model.importers.torch_file import read_tensors

__all__ = ["import_aves"]

OWN_PRIOR_KEYS = ("pose_mean", "pose_cov", "bone_mean", "bone_cov")
"""The same four tensors as `PRIOR_KEYS`, by their names in `aves.pt`."""


def import_aves(pt_path: Path | str, prior_path: Path | str | None = None) -> Bird:
    """Import the multi-species model: 3932 vertices, 25 joints, 18 keypoints, 15 shape directions.

    `V` is the mean shape. `Beta` holds unit vectors over all vertices, and the code of AVES multiplies them by
    `Beta_sigma`. `shape_basis` is this product, so `betas` have the same meaning here as in AVES.

    The code of AVES treats σ (`Beta_sigma`) as standard deviations, but the values are the variances along each
    vector. If σ were standard deviations, one unit of the first coefficient would lengthen a bird of 23 units by 18,
    and the cowbird of Badger et al. (`beta_original`) would lie implausibly close to the mean: χ² = 0.9 for 15
    coefficients instead of 10.8. Hence `shape_variance` = σ/σ² = 1/σ. The fit of AVES itself uses no variance, but
    the penalty 150·‖betas‖₂. A fit needs neither `beta_original` nor `vert2kpt_cub` (the 15 parts of CUB), so the
    importer skips both.

    Args:
        pt_path: `aves.pt`, in model units; the file contains the same priors as avian-mesh.
        prior_path: a `pose_bone_prior.pth` that replaces the priors of `aves.pt`.

    Raises:
        InputError: a file is missing or damaged, a field is missing, or a field has a wrong shape or wrong numbers.
    """
    tensors = read_tensors(pt_path)
    if prior_path is None:
        prior = read_prior(tensors, OWN_PRIOR_KEYS, pt_path)
    else:
        prior = read_prior(read_tensors(prior_path), PRIOR_KEYS, prior_path)
    directions = read_numbers(tensors, "Beta", "f", pt_path)
    sigma = read_numbers(tensors, "Beta_sigma", "f", pt_path)
    if directions.ndim != 3 or sigma.shape != directions.shape[:1]:
        problem = f"shapes {directions.shape} and {sigma.shape}, expected (S, V, 3) and (S,)"
        raise InputError(pt_path, f"Beta, Beta_sigma: {problem}", "use aves.pt as published")
    if not np.all(sigma > 0):
        raise InputError(pt_path, "Beta_sigma: must be positive", "use aves.pt as published")
    shape = (directions * sigma[:, None, None], 1.0 / sigma)
    return build_bird("aves", tensors, prior, AVES_KEYPOINTS, pt_path, shape)
