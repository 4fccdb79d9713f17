"""`jaxfit adapt photos`: a known species, a bad image, fixed parts, images without masks, tracks, wrong arguments."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfit.adapt.compare import compare_birds
from jaxfit.adapt.photo_fit import PhotoSettings, fit_photographs
from jaxfit.adapt.photographs import MOST_FRAMES, _few_frames, read_photographs
from jaxfit.adapt.species import absolute_bones, symmetric_bones
from jaxfit.cli.main import main
from jaxfit.data.formats.coco import write_coco
from jaxfit.model.files import load_bird, load_murre, save_bird
from jaxfit.simulation.species import random_species, simulate_photographs
from jaxfit.storage.npz import load_npz

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
    assert "1 of 5 images have no mask" in capsys.readouterr().out
    model = load_bird(tmp_path / "m.npz")
    assert np.array_equal(model.vertices, bird.vertices)
    assert not np.array_equal(model.bone_mean, bird.bone_mean)
    lines = list(load_npz(tmp_path / "m.npz", {"provenance": "lines"})["provenance"])
    assert {"free: bones", "images: 5", "individuals: 5", "images_with_mask: 4"} <= set(lines)


@pytest.mark.parametrize(("fixed", "says"), [("feathers", "not a part"), ("bones,shape,offset", "nothing is left")])
def test_wrong_parts_are_one_line_errors(tmp_path, capsys, fixed, says):
    assert main(["adapt", "photos", "absent.json", "--out", str(tmp_path / "m.npz"), "--fix", fixed]) == 2
    assert says in capsys.readouterr().err


def test_a_track_gives_few_frames(photographs):
    observations = photographs[2].select(tracks=np.array([1]))
    frames = 25
    long = replace(
        observations,
        frame_index=np.arange(frames),
        present=np.ones((1, frames), bool),
        keypoints_px=np.repeat(observations.keypoints_px, frames, axis=1),
        confidence=np.repeat(observations.confidence, frames, axis=1),
        occluded=None,
        score=None,
        timestamp_s=None,
        box_px=np.repeat(observations.box_px, frames, axis=1),
        image_size_px=np.full((frames, 2), 256),
        file_name=np.array([str(t) for t in range(frames)]),
        own_images={},
        masks={},
    )
    used = np.flatnonzero(_few_frames(long, 4).usable(4)[0])
    assert len(used) == MOST_FRAMES
    assert used[[0, -1]].tolist() == [0, frames - 1]


def test_left_and_right_bones_share_one_length():
    bird = load_murre()
    matrix = symmetric_bones(bird)
    assert matrix.sum() == bird.num_joints - 1
    names = np.array(bird.joint_names[1:])
    pairs = [set(names[column > 0]) for column in matrix.T]
    assert {"left_wrist", "right_wrist"} in pairs
    assert {"head"} in pairs
