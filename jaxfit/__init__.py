"""3D pose and shape of birds from ordinary video, consistent in time, on a CPU.

    import jaxfit

    bird = jaxfit.load_murre()
    observations = jaxfit.read_coco("birds.json")
    solution = jaxfit.fit(observations, bird, jaxfit.load_config("paper"))
    print(solution.keypoints.px.shape, solution.status)

All public names, by subject; `help(jaxfit.fit)` and the like describe one name.

Video to birds
    reconstruct             track the birds of a video, fit their poses, draw them: a `Reconstruction`
    run_tracking            track only: observations, trust (`Trust`), skipped tracks, damaged frames
    track_video             track only: the `Observations`
    load_segmenter          a network that detects birds
    load_keypoint_detector  a network that detects keypoints
    suggest                 choose frames to label

Keypoints and masks
    Observations            tracks of keypoints, boxes and masks
    read_coco, write_coco   files of jaxfit
    read_observations       files of DeepLabCut, SLEAP, Lightning Pose and others
    propose_names           which keypoint of a model each keypoint of a file is
    map_keypoints           the observations with the keypoints of the model
    track_quality           coverage, confidence and jitter of every track

Poses
    fit                     fit the poses of all birds: a `Solution`
    learn_weights           learn weights of the terms from the observations, before the fit
    term                    register a term of your own
    open_cluster            fit in several processes
    load_solution           read a result folder: the `Solution` and its `Bird`
    save_solution           write a result folder
    export_result           write a result for other programs

Models
    Bird                    mesh, joints, keypoints and priors of a species
    load_murre              the built-in model
    load_bird, save_bird    files of models
    find_bird               a model by its name or its file

Settings
    load_config             a `FitConfig`: `paper`, `map`, … or a YAML file
    load_reconstruct_config a `ReconstructConfig`, which contains a `TrackConfig`
    with_values             a config with other values

Measure
    read_truth              annotations, masks or a simulated scene: a `Truth`
    match_tracks            give tracks the numbers of the true birds that they follow
    evaluate                compare a result with the truth: an `Evaluation`
    sweep                   fit and measure under many values, in memory: a `Sweep`, with tables and a plot
    ablate                  the same from files, with tables and a report

Pictures
    overlay, overlay_frame  draw the birds on their video, or on one frame
    contact_sheet           a picture with some frames of every bird

Simulation
    simulate                film a scene with known truth
    stage_scene             the same without the film: a `Scene`

InputError is raised for a file or an argument that jaxfit cannot use. `__version__` is the version.
"""

import sys
from typing import Any

import lazy_loader

_import_name, __dir__, _names = lazy_loader.attach_stub(__name__, __file__)  # `__init__.pyi` says where the names are


def __getattr__(name: str) -> Any:
    """Import a public name at its first use, because all modules together take seconds."""
    if name != "__all__":
        return _import_name(name)
    if sys._getframe(1).f_globals.get("__name__") == "pydoc":  # it prints each of `__all__` in full: 1,700 lines
        raise AttributeError(name)
    return _names
