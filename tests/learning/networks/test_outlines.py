"""The training of the network that sees outlines: simulated outlines, samples, loss, exported maps."""

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `train` (PyTorch)")

from torch import nn  # noqa: E402
from torch.utils.data import default_collate  # noqa: E402

from jaxfit.foundation.errors import InputError  # noqa: E402
from jaxfit.learning.networks import outlines, training  # noqa: E402
from jaxfit.learning.networks.outlines import NAMES, OTHER_SIDE, SIDE_PX, STRIDE, OutlineMaps, draw_outlines  # noqa: E402
from jaxfit.learning.networks.training import Schedule, train_outline  # noqa: E402
from jaxfit.model.files import load_murre  # noqa: E402
from jaxfit.perception.keypoints import load_keypoint_detector  # noqa: E402
from jaxfit.perception.network import OnnxModel  # noqa: E402

CELLS = SIDE_PX // STRIDE


@pytest.fixture(scope="module")
def drawn():
    return draw_outlines([load_murre()], 1, seed=3)


def test_outlines_are_upright_birds(drawn):
    masks = np.unpackbits(drawn.masks, axis=1).reshape(-1, outlines.DRAWN_PX, outlines.DRAWN_PX)
    assert (masks.sum((1, 2)) > 300).all()
    crown, feet = (drawn.keypoints_px[:, NAMES.index(name), 1] for name in ("crown", "left_shin"))
    assert (crown < feet).mean() > 0.6  # y points down; a third flies, or is seen from above
    x, y = np.clip(drawn.keypoints_px[:, NAMES.index("back")].astype(int), 0, outlines.DRAWN_PX - 1).T
    assert masks[np.arange(len(masks)), y, x].mean() > 0.8
    again = draw_outlines([load_murre()], 1, seed=3)
    np.testing.assert_array_equal(again.masks, drawn.masks)


def test_samples_show_the_bird(drawn):
    samples = [outlines.draw_sample(np.random.default_rng(i), drawn) for i in range(40)]
    for sample in samples:
        assert sample.picture.shape == (3, SIDE_PX, SIDE_PX)
        assert sample.picture[0].max() > 0.5
        assert not (np.minimum(sample.picture[0], sample.picture[2]) > 0.9).any()
    breast = NAMES.index("breast")
    inside = []
    for sample in samples:
        if sample.present[breast]:
            x, y = (sample.position[breast] * STRIDE).astype(int)
            inside.append(sample.picture[0, max(y - 6, 0) : y + 7, max(x - 6, 0) : x + 7].max() > 0.5)
    assert np.mean(inside) > 0.85


def maps_with_peaks(cells, side_logit):
    """Logits with a peak of each keypoint in the cells (K, 2), and the map of p."""
    logits = torch.full((1, len(NAMES), CELLS, CELLS), -8.0)
    for k, (x, y) in enumerate(cells):
        logits[0, k, y, x] = 8.0
    return {"logits": logits, "side": torch.full((1, 1, CELLS, CELLS), float(side_logit))}


def test_the_loss_of_pairs_is_that_of_a_mixture():
    """With p = 1/2, exchanged sides cost the same. A sure network pays for a wrong p."""
    cells = np.stack([np.arange(len(NAMES)) + 2, (np.arange(len(NAMES)) * 5) % 17 + 2], axis=1)

    def loss(order, side_logit):
        sample = outlines.KeypointSample(
            torch.zeros(1, 3, SIDE_PX, SIDE_PX),
            torch.as_tensor(cells[order] + 0.5).float()[None],
            torch.ones(1, len(NAMES)),
            torch.ones(1, len(NAMES)),
        )
        return float(outlines.loss(maps_with_peaks(cells, side_logit), sample)["position"])

    true = np.arange(len(NAMES))
    assert loss(true, 0) == pytest.approx(loss(OTHER_SIDE, 0), rel=1e-5)
    assert loss(true, 3) == pytest.approx(loss(OTHER_SIDE, -3), rel=1e-5)
    extra = 6 / len(NAMES)  # log p of both differs by the logit
    assert loss(true, -6) - loss(true, 6) == pytest.approx(extra, rel=1e-2)
    single = true.copy()
    single[[NAMES.index("crown"), NAMES.index("breast")]] = single[[NAMES.index("breast"), NAMES.index("crown")]]
    assert loss(single, 0) > loss(true, 0) + 0.2  # only whole birds are exchanged


def test_exported_maps_hold_both_places_of_a_pair():
    class Fixed(nn.Module):
        def forward(self, pictures):
            maps = maps_with_peaks(cells, np.log(3.0))  # p = 3/4
            if pictures[0, 0, 0, 0] == 0:  # the mirror image
                maps["logits"] = maps["logits"].flip(3)[:, OTHER_SIDE]
            return maps

    cells = np.full((len(NAMES), 2), 12)
    left, right = NAMES.index("left_wingtip"), NAMES.index("right_wingtip")
    cells[left], cells[right] = (4, 6), (19, 6)
    picture = torch.zeros(1, 3, SIDE_PX, SIDE_PX)
    picture[0, 0, 0, 0] = 1
    maps = OutlineMaps(Fixed())(picture)[0].numpy()
    height = maps[NAMES.index("crown"), 12, 12]
    assert maps[left, 6, 4] == pytest.approx(0.75 * height, rel=1e-3)
    assert maps[left, 6, 19] == pytest.approx(0.25 * height, rel=1e-3)
    assert maps[right, 6, 19] == pytest.approx(0.75 * height, rel=1e-3)
    assert maps[NAMES.index("left_eye"), 12, 12] == pytest.approx(height, rel=1e-3)  # both at one place


def test_a_training_writes_a_network_that_is_read(monkeypatch, tmp_path):
    def batches(sources, batch, seed, first, last):
        samples = training.Samples(sources, seed, first * batch, (last - first) * batch)
        for step in range(last - first):
            yield default_collate([samples[i] for i in range(step * batch, (step + 1) * batch)])

    monkeypatch.setattr(training, "batches", batches)
    path, schedule = tmp_path / "outline.onnx", Schedule(20, 4, 1e-3)
    losses = train_outline(path, [load_murre()], tmp_path / "drawn", 1, schedule)
    assert 2 < losses["position"] < 20
    assert [file.name for file in (tmp_path / "drawn").iterdir()] == ["outlines_1_murre_0.npz"]
    detector = load_keypoint_detector(path)
    assert detector.keypoint_names == NAMES
    assert detector.sees_outlines
    facts = OnnxModel(path).metadata
    assert json.loads(facts["schedule"])["steps"] == 20
    assert "1 species" in facts["trained_on"]
    with pytest.raises(InputError, match="ONNX"):
        train_outline(tmp_path / "outline.txt", [load_murre()], tmp_path / "drawn")
