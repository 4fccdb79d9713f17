"""jaxfit: temporally consistent 3D pose and shape of birds from ordinary video, on a CPU."""

from importlib import metadata

from jaxfit.config import FitConfig, load_config
from jaxfit.errors import InputError
from jaxfit.evaluation.evaluate import Evaluation, evaluate
from jaxfit.fitting.fit import fit
from jaxfit.fitting.solution import Solution, load_solution, save_solution
from jaxfit.formats.coco import read_coco, write_coco
from jaxfit.model.bird import Bird
from jaxfit.model.files import find_bird, load_bird, load_murre, save_bird
from jaxfit.observations import Observations
from jaxfit.simulation.scene import Scene, simulate, stage_scene
from jaxfit.view.overlay import overlay

__version__ = metadata.version("jaxfit")

__all__ = [
    "Bird",
    "Evaluation",
    "FitConfig",
    "InputError",
    "Observations",
    "Scene",
    "Solution",
    "evaluate",
    "find_bird",
    "fit",
    "load_bird",
    "load_config",
    "load_murre",
    "load_solution",
    "overlay",
    "read_coco",
    "save_bird",
    "save_solution",
    "simulate",
    "stage_scene",
    "write_coco",
]
