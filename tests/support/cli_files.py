"""Input files of the command line, and a check of its error messages."""

import dataclasses

import numpy as np

from jaxfit.cli.main import main
from jaxfit.data.formats.coco import write_coco
from jaxfit.model.camera import CropCamera
from jaxfit.model.files import save_bird
from jaxfit.simulation.flock import smooth_motion
from jaxfit.simulation.noise import detect
from support.birds import toy_bird

BIRD, T, SIZE = toy_bird(shapes=0), 6, 64
CONFIG = """
base: paper
window: 6
crop: {mode: image, size_px: 64}
terms: {keypoints: 6.25, pose_prior: 0.1, velocity: 0.1}
stages:
  - {name: only, steps: 150, terms: [keypoints, pose_prior, velocity], step_scale: {transl: [1, 1, 0]}}
"""


def write_inputs(folder):
    """Write a model, observations of three birds (the last bird has three keypoints) and a config."""
    save_bird(BIRD, folder / "toy.npz")
    observed = detect(BIRD, [smooth_motion(BIRD, T, seed) for seed in range(3)], camera=CropCamera(541.75, 32, SIZE))
    confidence = observed.confidence.copy()
    confidence[2, :, 3:] = 0
    observed = observed.with_keypoints(observed.keypoints_px, confidence)
    write_coco(dataclasses.replace(observed, track_id=np.array([4, 7, 9])), folder / "birds.json")
    (folder / "quick.yaml").write_text(CONFIG)


def arguments(inputs, out, **changes):
    """Return the arguments of `jaxfit fit`, with other files for the names in `changes`."""
    names = {"obs": "birds.json", "model": "toy.npz", "config": "quick.yaml"} | changes
    paths = {name: str(inputs / value) for name, value in names.items()}
    return ["fit", paths["obs"], "--model", paths["model"], "--config", paths["config"], "--out", str(out)]


def rejected(capsys, command, *words, code=2, alone=True):
    """Check that a command returns `code` and prints one line on stderr that contains all words."""
    capsys.readouterr()
    assert main(command) == code
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 or (not alone and lines), "only a progress bar may precede the line"
    assert lines[-1].startswith("jaxfit: ")
    assert not any("Traceback" in line for line in lines)
    for word in words:
        assert word in lines[-1], f"{word!r} is not in {lines[-1]!r}"
