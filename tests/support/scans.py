"""A small scan with known truth, and its files."""

import json

import numpy as np
import trimesh

from jaxfit.model.files import load_murre
from jaxfit.simulation.species import random_species, simulate_scan


def small_scan(seed=6, **changes):
    """Return the murre, a species near the murre, and a scan of this species.

    The rounding of a processor decides which vertices a scan has, and so its noise. With several such noises of scan 6,
    the bones of an adapted model are well within the bounds of the tests. Scan 5 lacks the head, and its bones are not.
    """
    bird = load_murre()
    species = random_species(bird, seed)
    return bird, species, simulate_scan(species, seed, **{"noise": 0.003, "scale": 2.0, **changes})


def write_scan(folder, scan, suffix=".ply", name="scan"):
    """Write a scan and its keypoints, and return both paths."""
    mesh, points = folder / f"{name}{suffix}", folder / f"{name}.json"
    trimesh.Trimesh(scan.vertices, scan.faces, process=False).export(mesh)
    points.write_text(json.dumps({key: np.asarray(value).tolist() for key, value in scan.keypoints.items()}))
    return mesh, points
