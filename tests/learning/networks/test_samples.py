"""Samples of the networks, losses and architectures. It needs the extra `train`."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `train` (PyTorch)")

from torch import nn  # noqa: E402

from jaxfit.learning.networks import keypoints, segmenter  # noqa: E402
from jaxfit.learning.networks.augment import randomise_appearance  # noqa: E402
from jaxfit.learning.networks.labelled_frames import SPREAD_UNITS, LabelledFrames, birds_with_spread_wings  # noqa: E402
from jaxfit.model.anatomy import MURRE_KEYPOINTS  # noqa: E402

K = len(MURRE_KEYPOINTS)


def two_squares():
    """Two white squares on black, 10 pixels per unit: bird 1 left, bird 2 right, keypoints along the diagonal."""
    pictures, owner = np.zeros((1, 400, 600, 3), np.uint8), np.zeros((1, 400, 600), np.uint8)
    points, visibility = np.zeros((1, 3, K, 2), np.float32), np.zeros((1, 3, K), np.uint8)
    for n, x0 in enumerate((100, 300)):
        owner[0, 150:250, x0 : x0 + 100] = n + 1
        pictures[0, 150:250, x0 : x0 + 100] = 255
        points[0, n] = np.linspace((x0 + 5, 155), (x0 + 95, 245), K)
        visibility[0, n] = 2
    return LabelledFrames(pictures, owner, points, visibility, np.array([10.0], np.float32))


def test_random_appearance():
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (96, 96, 3), np.uint8)
    birds = np.zeros((96, 96), bool)
    birds[30:60, 30:60] = True
    results = [randomise_appearance(np.random.default_rng(i), picture, birds) for i in range(40)]
    assert all(result.shape == picture.shape and result.dtype == np.uint8 for result in results)
    assert np.array_equal(results[3], randomise_appearance(np.random.default_rng(3), picture, birds))
    assert np.std([result.mean() for result in results]) > 10


def test_segmenter_targets():
    """The offset of every cell of a square ends at the centre of the square."""
    tried = 0
    for i in range(12):
        sample = segmenter.draw_sample(np.random.default_rng(i), two_squares())
        side = segmenter.SIDE_PX // segmenter.STRIDE
        at = (np.indices((side, side))[::-1] + 0.5) * segmenter.STRIDE
        ends = at + sample.offset * segmenter.OFFSET_UNIT_PX
        birds = sample.offset_weight[0] > 0
        centres, bird = np.unique(np.round(ends[:, birds], 1), axis=1, return_inverse=True)
        assert centres.shape[1] <= 2  # the cells of a bird point to one centre
        sums = np.bincount(bird.ravel(), sample.offset_weight[0][birds])
        assert sums == pytest.approx(np.ones(len(sums)), abs=1e-4)
        tried += len(sums)
        assert sample.foreground[0][birds].mean() > 0.9
    assert tried > 8


def test_scales_of_the_samples():
    """A square of 10 units has 42 to 115 pixels at a usual scale, and 30 (by RESAMPLING) to 150 at a wide scale."""

    def lengths(wide_share):
        samples = [segmenter.draw_sample(np.random.default_rng(i), two_squares(), 0.0, wide_share) for i in range(60)]
        areas = [1 / sample.offset_weight[sample.offset_weight > 0].min() for sample in samples if sample.centre.any()]
        return segmenter.STRIDE * np.sqrt(areas)

    usual, wide = lengths(0.0), lengths(1.0)
    assert usual.max() < 1.05 * 115
    assert wide.max() > 1.1 * 115
    assert np.percentile(wide, 10) < 42 < np.percentile(usual, 40)


def test_birds_with_spread_wings():
    """Only bird 2 has wingtips that are far apart; of bird 3, nothing is visible."""
    frames = two_squares()
    left, right = (MURRE_KEYPOINTS.index(f"{side}_wingtip") for side in ("left", "right"))
    frames.keypoints_px[0, :, left] = frames.keypoints_px[0, :, right]
    frames.keypoints_px[0, 1:, left, 0] += 10 * (SPREAD_UNITS + 0.1)
    assert birds_with_spread_wings(frames).tolist() == [[0, 1]]
    assert not len(birds_with_spread_wings(frames.with_keypoints(["beak", "tail"])))


def test_keypoint_targets():
    """Keypoints lie at equal distances on the diagonal of a square, also after augmentation and cropping."""
    for i in range(12):
        sample = keypoints.draw_sample(np.random.default_rng(i), two_squares())
        position = sample.position
        order = list(keypoints._opposite(MURRE_KEYPOINTS))
        for candidate in (position, position[order]):
            steps = np.diff(candidate, axis=0)
            if np.ptp(steps, axis=0).max() < 1e-3:
                break
        else:
            pytest.fail("the keypoints are no longer on a line")
        assert np.hypot(*steps.mean(0)) * (K - 1) * keypoints.STRIDE > 60  # the square fills much of its crop
        assert (sample.present == ((position >= 0) & (position < 48)).all(-1)).all()


def test_losses_are_lowest_for_the_true_maps():
    sample = segmenter.draw_sample(np.random.default_rng(1), two_squares())
    batch = segmenter.SegmenterSample(*(torch.from_numpy(part)[None] for part in sample))
    right = {
        "foreground": 20 * (batch.foreground - 0.5),
        "centre": batch.centre.clone(),
        "offset": batch.offset.clone(),
    }
    best = segmenter.loss(right, batch)
    assert best["centre"] < 1e-9
    assert best["offset"] < 1e-9
    for name in right:
        worse = segmenter.loss({**right, name: right[name] + 1.0}, batch)
        assert worse[name] > best[name]

    crop = keypoints.draw_sample(np.random.default_rng(1), two_squares())
    crops = keypoints.KeypointSample(*(torch.from_numpy(part)[None] for part in crop))
    logits = torch.full((1, K, 48, 48), -30.0)
    centres = torch.arange(48) + 0.5
    for k, (x, y) in enumerate(crop.position):
        if crop.present[k]:
            logits[0, k] = 20 - ((centres - x) ** 2 + (centres[:, None] - y) ** 2) / (2 * keypoints.SIGMA_CELLS**2)
    absent = torch.full((1, K, 48, 48), -30.0)
    near = keypoints.loss({"logits": logits}, crops)["position"]
    flat = keypoints.loss({"logits": torch.zeros(1, K, 48, 48)}, crops)["position"]
    assert flat == pytest.approx(np.log(48 * 48 + 1), rel=1e-4)  # a uniform distribution
    assert near < 0.5 * flat
    assert near < keypoints.loss({"logits": absent}, crops)["position"]


def test_peaks_are_probabilities():
    class Logits(nn.Module):
        def forward(self, pictures):
            logits = torch.full((1, 3, 12, 12), -20.0)
            logits[0, 0, 5, 7] = 20.0  # certainly here
            logits[0, 1, 3, 3] = 0.0  # here or absent, with equal probability
            return {"logits": logits}

    maps = keypoints.KeypointMaps(Logits(), 3)(torch.zeros(1, 3, 48, 48))[0]
    assert maps[0, 5, 7] == pytest.approx(1, abs=1e-3)
    assert maps[1, 3, 3] == pytest.approx(0.5, abs=1e-3)
    assert maps[2].max() < 1e-3
    assert maps[0].argmax() == 5 * 12 + 7


def test_the_encoder_of_the_segmenter_learns_slowly_and_its_first_stages_not_at_all():
    torch.manual_seed(0)
    network = segmenter.segmenter_network()
    groups = network.parameter_groups()
    assert [group["share"] for group in groups] == [0.1, 1.0]
    assert {id(p) for p in groups[0]["params"]} == {id(p) for p in network.down.parameters()}
    assert sum(len(group["params"]) for group in groups) == len(list(network.parameters()))
    trained = [any(p.requires_grad for p in stage.parameters()) for stage in network.down]
    assert trained == [False] * segmenter.FIXED_STAGES + [True] * (5 - segmenter.FIXED_STAGES)
    maps = network.eval()(torch.zeros(1, 3, 64, 64))
    assert {name: tuple(map_.shape[1:]) for name, map_ in maps.items()} == {
        "foreground": (1, 32, 32),
        "centre": (1, 32, 32),
        "offset": (2, 32, 32),
    }
