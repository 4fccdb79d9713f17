"""`jaxfit adapt photos`: a known species, a bad image, fixed parts, images without masks, tracks, wrong arguments."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfit.cli.main import main
from jaxfit.data.formats.coco import write_coco
from jaxfit.data.observations import Observations
from jaxfit.foundation.array_files import load_npz
from jaxfit.learning.species.models import compare_birds
from jaxfit.learning.species.photo_fit import PhotoSettings, fit_photographs
from jaxfit.learning.species.photographs import FRAMES_PER_TRACK, _few_frames, _remarks, read_photographs
from jaxfit.learning.species.species import absolute_bones
from jaxfit.model.files import load_bird, load_murre, save_bird
from jaxfit.simulation.species import random_species, simulate_photographs


@pytest.fixture(scope="module")
def photographs():
    """A species near the murre, photographs with one bad image (the first) and one without a mask (the last)."""
    bird = load_murre()
    species = random_species(bird, 2)
    observations = simulate_photographs(species, 6, 2, seen=1.0)
    points = observations.keypoints_px.copy()
    points[0] = points[0, :, ::-1]  # every keypoint has the name of another keypoint
    masks = {key: mask for key, mask in observations.masks.items() if key[0] != 5}
    observations = replace(observations.with_keypoints(points, observations.confidence), masks=masks)
    return bird, species, observations


def bone_error(bird, species):
    """Return the mean error of the bones up to one common factor."""
    ratio = absolute_bones(bird) / absolute_bones(species)
    return np.abs(ratio / np.median(ratio) - 1).mean()


@pytest.mark.extended
def test_the_species_is_nearer_to_the_truth_than_the_base_in_spite_of_a_bad_image(photographs, tmp_path):
    bird, species, observations = photographs
    images = read_photographs([("photographs", observations)], bird)
    assert images.has_mask.tolist() == [True] * 5 + [False]
    assert "photograph_000.png" in images.names[0]
    fit = fit_photographs(images, bird, PhotoSettings(modes=3, rounds=(60, 40, 40)))
    assert fit.disagreeing == [0]
    assert fit.weight[0] < 0.1
    assert bone_error(fit.bird, species) < 0.9 * bone_error(bird, species)
    error = compare_birds(species, fit.bird).of_first.mean()
    assert error < 0.6 * compare_birds(species, bird).of_first.mean()
    save_bird(fit.bird, tmp_path / "m.npz")  # checks all fields
    for left, right in bird.joint_pairs:
        assert float(fit.bird.bone_mean[left - 1]) == pytest.approx(float(fit.bird.bone_mean[right - 1]), abs=1e-6)
    assert (np.linalg.eigvalsh(np.asarray(fit.bird.bone_covariance, float)) > 0).all()


@pytest.mark.extended
def test_the_command_writes_a_model_with_provenance_and_keeps_fixed_parts(photographs, tmp_path, capsys):
    bird, _, observations = photographs
    write_coco(observations.select(tracks=np.arange(1, 6)), tmp_path / "birds.json")
    arguments = ["adapt", "photos", str(tmp_path / "birds.json"), "--out", str(tmp_path / "m.npz")]
    assert main([*arguments, "--fix", "shape,offset"]) == 0
    printed = capsys.readouterr().out
    assert "1 of 5 images have no mask" in printed
    assert "5 images of 5 individuals" in printed
    assert "prior ± %" in printed
    model = load_bird(tmp_path / "m.npz")
    assert np.array_equal(model.vertices, bird.vertices)
    assert not np.array_equal(model.bone_mean, bird.bone_mean)
    lines = list(load_npz(tmp_path / "m.npz", {"provenance": "lines"})["provenance"])
    assert {"free: bones", "images: 5", "individuals: 5", "images_with_mask: 4", "frames_per_track: 10"} <= set(lines)
    assert any(line.startswith("bones_not_determined: ") for line in lines)


@pytest.mark.parametrize(
    ("option", "says"),
    [
        (["--fix", "feathers"], "not a part"),
        (["--fix", "bones,shape,offset"], "nothing is left"),
        (["--frames-per-track", "0"], "--frames-per-track: is 0"),
    ],
)
def test_wrong_options_are_one_line_errors(tmp_path, capsys, option, says):
    assert main(["adapt", "photos", "absent.json", "--out", str(tmp_path / "m.npz"), *option]) == 2
    assert says in capsys.readouterr().err


def test_a_track_gives_few_frames():
    for most, used in ((FRAMES_PER_TRACK, 10), (2, 2), (25, 25), (104, 25)):
        chosen = np.flatnonzero(_few_frames(labelled_track(25), 1, most).usable(1)[0])
        assert len(chosen) == used
        assert chosen[[0, -1]].tolist() == [0, 24]


def labelled_track(frames):
    """Return observations of one bird with one keypoint."""
    return Observations(
        track_id=np.zeros(1, int),
        frame_index=np.arange(frames),
        present=np.ones((1, frames), bool),
        keypoints_px=np.full((1, frames, 1, 2), 5, np.float32),
        confidence=np.ones((1, frames, 1), np.float32),
        box_px=np.full((1, frames, 4), 9, np.float32),
        image_size_px=np.full((frames, 2), 256),
        file_name=np.array([str(t) for t in range(frames)]),
        keypoint_names=("centre",),
    )


def test_remarks_say_how_many_images_are_used_and_why():
    assert _remarks("a.json", 30, 30, 30, 30, 10) == []
    few, track, failed = _remarks("a.json", 110, 104, 10, 8, 10)
    assert few == "a.json: 6 of 110 images are not used: too few keypoints"
    assert track.startswith("a.json: 10 of 104 images are used: at most 10 of each track, at equal distances")
    assert "--frames-per-track" in track
    assert failed == "a.json: 2 of 10 images are not used: the fit of their keypoints failed"
