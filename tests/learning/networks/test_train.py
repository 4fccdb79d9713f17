"""Training on simulated frames: labels, samples, losses, export. It needs the extra `train`."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `train` (PyTorch)")

from jaxfit.foundation.errors import InputError  # noqa: E402
from jaxfit.learning.networks import familiarity, keypoints, scenes, segmenter  # noqa: E402
from jaxfit.learning.networks.augment import randomise_appearance  # noqa: E402
from jaxfit.learning.networks.labelled_frames import SPREAD_UNITS, LabelledFrames, birds_with_spread_wings, load_frames  # noqa: E402
from jaxfit.learning.networks.loop import Schedule  # noqa: E402
from jaxfit.learning.networks.networks import FeaturePyramid, residual_stages  # noqa: E402
from jaxfit.learning.networks.scenes import FRAMES_PER_SCENE, film_scenes  # noqa: E402
from jaxfit.learning.networks.train import Simulation, train_network  # noqa: E402
from jaxfit.model.anatomy import MURRE_KEYPOINTS  # noqa: E402
from jaxfit.perception.keypoints import BUILTIN_PATH, load_keypoint_detector  # noqa: E402
from jaxfit.perception.network import (  # noqa: E402
    MEAN_KEY,
    WHITENING_KEY,
    OnnxModel,
)
from jaxfit.perception.segmentation import load_segmenter  # noqa: E402

K = len(MURRE_KEYPOINTS)
QUICK = Schedule(20, 2, 1e-3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames") / "frames"
    film_scenes(folder, range(1), workers=1)
    return folder


@pytest.fixture(scope="module")
def frames(folder):
    return load_frames(folder)


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


def test_visible_keypoints_lie_on_their_bird(frames):
    assert frames.pictures.shape[0] == FRAMES_PER_SCENE
    assert frames.pictures.std() > 10
    visible = np.argwhere(frames.visibility == 2)
    assert len(visible) > 100
    own = 0
    for s, n, k in visible:
        x, y = frames.keypoints_px[s, n, k].astype(int)
        own += (frames.owner[s, max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3] == n + 1).any()
    assert own > 0.99 * len(visible)  # the thinnest tips fall between pixels


@pytest.mark.extended
def test_same_seed_gives_the_same_frames(frames):
    again = scenes._film_scene(0)
    assert np.array_equal(again.owner, frames.owner)
    assert np.array_equal(again.pictures, frames.pictures)


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
    class Logits(torch.nn.Module):
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


def test_pyramid_strides():
    network = FeaturePyramid(residual_stages((4, 8, 12), (0, 1, 1)), (4, 8, 12), (8, 6), {"a": 2, "b": 1}).eval()
    maps = network(torch.zeros(1, 3, 32, 48))
    assert {name: tuple(map_.shape) for name, map_ in maps.items()} == {"a": (1, 2, 16, 24), "b": (1, 1, 16, 24)}


@pytest.fixture
def _few_pictures(monkeypatch):
    """Training activations of few pictures, because the networks of these tests are not used."""
    monkeypatch.setattr(familiarity, "MAX_PICTURES", 20)


@pytest.mark.extended
@pytest.mark.usefixtures("_few_pictures")
def test_trained_segmenter_is_read_back(folder, frames, tmp_path):
    losses = train_network("segmenter", tmp_path / "s.onnx", Simulation(folder, 1), QUICK)
    assert set(losses) == {"foreground", "centre", "offset"}
    model = OnnxModel(tmp_path / "s.onnx")
    assert "no real footage" in model.metadata["trained_on"]
    texts = [text for key, text in model.metadata.items() if key not in (MEAN_KEY, WHITENING_KEY)]
    assert "/" not in "".join(texts)  # no local paths
    assert load_segmenter(tmp_path / "s.onnx").class_names == ("bird",)
    outputs = model(np.zeros((1, 3, 64, 96), np.float32))
    assert outputs["foreground"].shape == (1, 1, 32, 48)
    assert (tmp_path / "s.onnx").stat().st_size < 7e6


@pytest.mark.extended
@pytest.mark.usefixtures("_few_pictures")
def test_trained_keypoint_network_is_read_back(folder, tmp_path):
    train_network("keypoints", tmp_path / "k.onnx", Simulation(folder, 1), QUICK)
    detector = load_keypoint_detector(tmp_path / "k.onnx")
    assert detector.keypoint_names == MURRE_KEYPOINTS
    assert (tmp_path / "k.onnx").stat().st_size < 4.8e6
    assert OnnxModel(tmp_path / "k.onnx").metadata["background"] == "visible"


@pytest.mark.extended
@pytest.mark.usefixtures("_few_pictures")
def test_a_training_from_a_base_network_begins_with_its_weights(folder, tmp_path):
    still = QUICK._replace(learning_rate=1e-12)
    train_network("keypoints", tmp_path / "k.onnx", Simulation(folder, 1), still, base="builtin")
    picture = np.random.default_rng(0).uniform(0, 1, (1, 3, 192, 192)).astype(np.float32)
    trained, builtin = (OnnxModel(path)(picture)["heatmaps"] for path in (tmp_path / "k.onnx", BUILTIN_PATH))
    np.testing.assert_allclose(trained, builtin, atol=2e-3)


def test_frames_of_an_earlier_version_are_rejected(frames, tmp_path):
    labels = {"keypoints_px": frames.keypoints_px, "seen": frames.visibility, "pixels_a_unit": frames.pixels_per_unit}
    np.savez(tmp_path / "frames.npz", **labels)
    with pytest.raises(InputError, match=r"frames\.npz: lacks the array visibility"):
        load_frames(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenes": 0}, "scenes"),
        ({"scenes": 3}, "holds 1 scenes"),
        ({"schedule": QUICK._replace(steps=3)}, "steps"),
        ({"wings": 2}, "wings"),
        ({"path": "n.pt"}, ".onnx"),
        ({"encoder": "e.pth", "base": "builtin"}, "is given with a base network"),
    ],
)
def test_invalid_arguments_are_rejected(folder, tmp_path, arguments, message):
    path = tmp_path / arguments.pop("path", "n.onnx")
    given = {key: arguments.pop(key) for key in ("scenes", "wings") if key in arguments}
    simulation = Simulation(folder, **{"scenes": 1, **given})
    with pytest.raises(InputError, match=message):
        train_network("segmenter", path, simulation, **arguments)
    assert not path.exists()
