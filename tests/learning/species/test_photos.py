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
from jaxfit.learning.species.species import absolute_bones, symmetric_bones
from jaxfit.model.files import load_bird, load_murre, save_bird
from jaxfit.simulation.species import random_species, simulate_photographs

QUICK = PhotoSettings(modes=3, rounds=(60, 40, 40))


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


@pytest.fixture(scope="module")
def fitted(photographs):
    bird, _, observations = photographs
    images = read_photographs([("photographs", observations)], bird)
    return images, fit_photographs(images, bird, QUICK)


def bone_error(bird, species):
    """Return the mean error of the bones up to one common factor."""
    ratio = absolute_bones(bird) / absolute_bones(species)
    return np.abs(ratio / np.median(ratio) - 1).mean()


@pytest.mark.extended
def test_a_bad_image_among_six_loses_its_weight_and_is_listed(photographs, fitted):
    images, fit = fitted
    assert fit.disagreeing == [0]
    assert fit.weight[0] < 0.1
    first = fit_photographs(images, photographs[0], QUICK._replace(rounds=(30,)))
    assert first.disagreeing == [0]  # found before masks are compared, and before the image bends the species


@pytest.mark.extended
def test_the_species_is_nearer_to_the_truth_than_the_base_in_spite_of_the_bad_image(photographs, fitted):
    bird, species, _ = photographs
    assert bone_error(fitted[1].bird, species) < 0.9 * bone_error(bird, species)
    error = compare_birds(species, fitted[1].bird).of_first.mean()
    assert error < 0.6 * compare_birds(species, bird).of_first.mean()


@pytest.mark.extended
def test_the_new_priors_are_covariances_and_images_without_masks_are_used(fitted, tmp_path):
    images, fit = fitted
    assert images.has_mask.tolist() == [True] * 5 + [False]
    assert "photograph_000.png" in images.names[0]
    bird = fit.bird
    save_bird(bird, tmp_path / "m.npz")  # checks all fields
    for left, right in bird.joint_pairs:
        assert float(bird.bone_mean[left - 1]) == pytest.approx(float(bird.bone_mean[right - 1]), abs=1e-6)
    assert (np.linalg.eigvalsh(np.asarray(bird.bone_covariance, float)) > 0).all()


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


@pytest.mark.parametrize(("fixed", "says"), [("feathers", "not a part"), ("bones,shape,offset", "nothing is left")])
def test_wrong_parts_are_one_line_errors(tmp_path, capsys, fixed, says):
    assert main(["adapt", "photos", "absent.json", "--out", str(tmp_path / "m.npz"), "--fix", fixed]) == 2
    assert says in capsys.readouterr().err


@pytest.mark.parametrize(("most", "used"), [(FRAMES_PER_TRACK, 10), (2, 2), (25, 25), (104, 25)])
def test_a_track_gives_few_frames(most, used):
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


def test_a_number_of_frames_below_1_is_an_error(tmp_path, capsys):
    arguments = ["adapt", "photos", "absent.json", "--out", str(tmp_path / "m.npz"), "--frames-per-track", "0"]
    assert main(arguments) == 2
    assert "--frames-per-track: is 0" in capsys.readouterr().err


def test_left_and_right_bones_share_one_length():
    bird = load_murre()
    matrix = symmetric_bones(bird)
    assert matrix.sum() == bird.num_joints - 1
    names = np.array(bird.joint_names[1:])
    pairs = [set(names[column > 0]) for column in matrix.T]
    assert {"left_wrist", "right_wrist"} in pairs
    assert {"head"} in pairs
