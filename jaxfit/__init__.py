"""jaxfit: temporally consistent 3D pose and shape of birds from ordinary video, on a CPU."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from jaxfit.extras import own_version

if TYPE_CHECKING:  # for type checkers and editors
    from jaxfit.ablation.ablate import ablate
    from jaxfit.ablation.sweep import sweep
    from jaxfit.config.fit import FitConfig, load_config
    from jaxfit.config.paths import with_values
    from jaxfit.config.perception import TrackConfig
    from jaxfit.config.reconstruct import ReconstructConfig, load_reconstruct_config
    from jaxfit.data.formats.coco import read_coco, write_coco
    from jaxfit.data.formats.recognise import read_observations
    from jaxfit.data.keypoint_names import map_keypoints, propose_names
    from jaxfit.data.observations import Observations
    from jaxfit.data.solution import Solution, load_solution, save_solution
    from jaxfit.data.track_quality import track_quality
    from jaxfit.errors import InputError
    from jaxfit.evaluation.evaluate import Evaluation, evaluate
    from jaxfit.evaluation.matching import match_tracks
    from jaxfit.evaluation.truth import Truth, read_truth
    from jaxfit.export.export import export_result
    from jaxfit.fitting.fit import fit
    from jaxfit.labelling.suggest import suggest
    from jaxfit.model.bird import Bird
    from jaxfit.model.files import find_bird, load_bird, load_murre, save_bird
    from jaxfit.objective.registry import term
    from jaxfit.perception.keypoints import load_keypoint_detector
    from jaxfit.perception.segmentation import load_segmenter
    from jaxfit.perception.track import run_tracking, track_video
    from jaxfit.perception.trust import Trust
    from jaxfit.pipeline import Reconstruction, reconstruct
    from jaxfit.simulation.scene import Scene, simulate, stage_scene
    from jaxfit.view.contact_sheet import contact_sheet
    from jaxfit.view.overlay import overlay, overlay_frame
    from jaxfit.workers.cluster import open_cluster

__version__ = own_version()

__all__ = [
    "Bird",
    "Evaluation",
    "FitConfig",
    "InputError",
    "Observations",
    "ReconstructConfig",
    "Reconstruction",
    "Scene",
    "Solution",
    "TrackConfig",
    "Trust",
    "Truth",
    "ablate",
    "contact_sheet",
    "evaluate",
    "export_result",
    "find_bird",
    "fit",
    "load_bird",
    "load_config",
    "load_keypoint_detector",
    "load_murre",
    "load_reconstruct_config",
    "load_segmenter",
    "load_solution",
    "map_keypoints",
    "match_tracks",
    "open_cluster",
    "overlay",
    "overlay_frame",
    "propose_names",
    "read_coco",
    "read_observations",
    "read_truth",
    "reconstruct",
    "run_tracking",
    "save_bird",
    "save_solution",
    "simulate",
    "stage_scene",
    "suggest",
    "sweep",
    "term",
    "track_quality",
    "track_video",
    "with_values",
    "write_coco",
]

_HOMES = {
    "ablation.ablate": ("ablate",),
    "ablation.sweep": ("sweep",),
    "config.fit": ("FitConfig", "load_config"),
    "config.paths": ("with_values",),
    "config.perception": ("TrackConfig",),
    "config.reconstruct": ("ReconstructConfig", "load_reconstruct_config"),
    "data.formats.coco": ("read_coco", "write_coco"),
    "data.formats.recognise": ("read_observations",),
    "data.keypoint_names": ("map_keypoints", "propose_names"),
    "data.observations": ("Observations",),
    "data.solution": ("Solution", "load_solution", "save_solution"),
    "data.track_quality": ("track_quality",),
    "errors": ("InputError",),
    "evaluation.evaluate": ("Evaluation", "evaluate"),
    "evaluation.matching": ("match_tracks",),
    "evaluation.truth": ("Truth", "read_truth"),
    "export.export": ("export_result",),
    "workers.cluster": ("open_cluster",),
    "fitting.fit": ("fit",),
    "labelling.suggest": ("suggest",),
    "model.bird": ("Bird",),
    "model.files": ("find_bird", "load_bird", "load_murre", "save_bird"),
    "objective.registry": ("term",),
    "perception.keypoints": ("load_keypoint_detector",),
    "perception.segmentation": ("load_segmenter",),
    "perception.track": ("run_tracking", "track_video"),
    "perception.trust": ("Trust",),
    "pipeline": ("Reconstruction", "reconstruct"),
    "simulation.scene": ("Scene", "simulate", "stage_scene"),
    "view.overlay": ("overlay", "overlay_frame"),
    "view.contact_sheet": ("contact_sheet",),
}
"""Module → its public names. A module is imported at the first use of a name: all modules together take seconds."""

if not TYPE_CHECKING:  # so that type checkers report unknown names

    def __getattr__(name: str) -> Any:
        for home, names in _HOMES.items():
            if name in names:
                value = globals()[name] = getattr(import_module(f"jaxfit.{home}"), name)
                return value
        raise AttributeError(f"module 'jaxfit' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
