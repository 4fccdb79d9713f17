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

__version__ = metadata.version("jaxfit")

__all__ = [
    "Bird",
    "Evaluation",
    "FitConfig",
    "InputError",
    "Observations",
    "Solution",
    "evaluate",
    "find_bird",
    "fit",
    "load_bird",
    "load_config",
    "load_murre",
    "load_solution",
    "read_coco",
    "save_bird",
    "save_solution",
    "write_coco",
]
