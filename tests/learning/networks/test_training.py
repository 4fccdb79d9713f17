"""The loop of a training: mixed samples, early stopping, resumption; trained networks are read back."""

from functools import partial

import numpy as np
import pytest
from support.labelled_pictures import bird, coco, write_labels

torch = pytest.importorskip("torch", reason="needs the extra `train` (PyTorch)")

from torch.utils.data import default_collate  # noqa: E402

from jaxfit.foundation.errors import InputError  # noqa: E402
from jaxfit.learning.networks import network_files, segmenter, training  # noqa: E402
from jaxfit.learning.networks.label_data import LabelFiles, prepare_data  # noqa: E402
from jaxfit.learning.networks.network_files import base_file  # noqa: E402
from jaxfit.learning.networks.networks import FeaturePyramid, residual_stages  # noqa: E402
from jaxfit.learning.networks.scenes import film_scenes  # noqa: E402
from jaxfit.learning.networks.training import (  # noqa: E402
    Samples,
    Schedule,
    Simulation,
    Source,
    train,
    train_network,
    weights_of,
)
from jaxfit.model.anatomy import MURRE_KEYPOINTS  # noqa: E402
from jaxfit.perception.keypoints import load_keypoint_detector  # noqa: E402
from jaxfit.perception.network import MEAN_KEY, WHITENING_KEY, OnnxModel  # noqa: E402
from jaxfit.perception.segmentation import load_segmenter  # noqa: E402

TIMES = range(0, 400, 50)
QUICK = Schedule(20, 2, 1e-3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder of labelled frames."""
    folder = tmp_path_factory.mktemp("labelled")
    file = write_labels(folder / "labels", coco({t: [bird(40 + t // 20, 30)] for t in TIMES}), list(TIMES))
    prepare_data("segmenter", LabelFiles((file,)), 0.25, None, folder / "training")
    return folder / "training" / "frames"


@pytest.fixture
def trained(monkeypatch, folder):
    """Return a function that trains a tiny network in this process; `stop_after` interrupts the training in this step.

    It returns the result, the number of steps taken and the network.
    """

    def batches(sources, batch, seed, first, last):
        samples = Samples(sources, seed, first * batch, (last - first) * batch)
        for step in range(last - first):
            yield default_collate([samples[i] for i in range(step * batch, (step + 1) * batch)])

    monkeypatch.setattr(training, "batches", batches)
    monkeypatch.setattr(segmenter, "SIDE_PX", 64)

    def run(path, score=None, stop_after=None):
        network, taken = tiny_network(), []

        def loss(maps, sample):
            if len(taken) == stop_after:
                raise KeyboardInterrupt
            taken.append(1)
            return segmenter.loss(maps, sample)

        sources = [Source((folder,), partial(segmenter.draw_sample, scene_share=0.5))]
        result = train(network, loss, sources, Schedule(10, 1, 1e-3), 3, True, path, "mark", score)
        return result, len(taken), network

    return run


def tiny_network():
    torch.manual_seed(0)
    return FeaturePyramid(residual_stages((4, 4), (0, 1)), (4, 4), (4,), {"foreground": 1, "centre": 1, "offset": 2})


def equal(one, other):
    return all(torch.equal(one[name], other[name]) for name in one)


def test_interrupted_training_gives_the_same_weights(trained, tmp_path):
    whole, _, network = trained(tmp_path / "whole.pt")
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "parts.pt", stop_after=6)
    resumed, steps, again = trained(tmp_path / "parts.pt")
    assert steps == 4
    assert resumed.step == whole.step == 10
    assert equal(again.state_dict(), network.state_dict())
    assert not equal(again.state_dict(), tiny_network().state_dict())
    finished, steps, _ = trained(tmp_path / "parts.pt")
    assert steps == 0
    assert equal(finished.best, whole.best)


def test_best_weights_and_early_stopping(trained, tmp_path):
    scores = iter([0.1, 0.5, 0.4, 0.5, 0.3, 0.2, 0.2, 0.1, 0.1, 0.1, 0.1, 0.1])
    best, steps, _ = trained(tmp_path / "best.pt", lambda: next(scores))
    assert steps == 7  # four measurements after the last measurement of 0.5, which follows step 3
    assert [score for _, score in best.history] == [0.1, 0.5, 0.4, 0.5, 0.3, 0.2, 0.2, 0.1]
    assert best.best_step == 3
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "short.pt", stop_after=3)
    assert equal(best.best, torch.load(tmp_path / "short.pt", weights_only=True)["network"])

    scores = iter([0.9, 0.1, 0.5, 0.4, 0.3])  # the initial weights are never the best weights
    best, steps, network = trained(None, lambda: next(scores))
    assert (steps, best.best_step) == (4, 2)
    assert not equal(best.best, tiny_network().state_dict())
    assert not equal(best.best, weights_of(network))


def test_state_of_another_training_is_rejected_and_no_code_is_executed(trained, tmp_path):
    class Code:
        def __reduce__(self):
            return (np.save, (str(tmp_path / "executed.npy"), np.zeros(1)))

    path = tmp_path / "state.pt"
    trained(path)
    state = torch.load(path, weights_only=True)
    other_shape = {name: torch.zeros(3) for name in state["network"]}
    for change, message in (
        ({"fingerprint": "other"}, "interrupted training with other labels or options"),
        ({"network": other_shape}, "state.pt"),
        ({"network": Code()}, "state.pt"),
    ):
        torch.save(state | change, path)
        with pytest.raises(InputError, match=message):
            trained(path)
    assert not (tmp_path / "executed.npy").exists()


def test_samples_come_from_both_sources_by_their_shares(folder):
    sources = [Source((folder,), lambda _rng, _frames, k=k: k, share) for k, share in enumerate((0.7, 0.3))]
    samples = Samples(sources, seed=1, first=100, count=400)
    drawn = [samples[i] for i in range(400)]
    assert np.mean(drawn) == pytest.approx(0.3, abs=0.07)
    later = Samples(sources, seed=1, first=150, count=400)
    assert [later[i] for i in range(50)] == drawn[50:100]  # a sample depends on its number only


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "scenes"
    film_scenes(folder, 1)
    return folder


@pytest.mark.extended
def test_trained_segmenter_is_read_back(scenes, tmp_path, monkeypatch):
    monkeypatch.setattr(network_files, "MAX_PICTURES", 20)
    losses = train_network("segmenter", tmp_path / "s.onnx", Simulation(scenes, 1), QUICK)
    assert set(losses) == {"foreground", "centre", "offset"}
    model = OnnxModel(tmp_path / "s.onnx")
    assert "no real footage" in model.metadata["trained_on"]
    texts = [text for key, text in model.metadata.items() if key not in (MEAN_KEY, WHITENING_KEY)]
    assert "/" not in "".join(texts)  # no local paths
    assert load_segmenter(tmp_path / "s.onnx").class_names == ("bird",)
    assert model(np.zeros((1, 3, 64, 96), np.float32))["foreground"].shape == (1, 1, 32, 48)
    assert (tmp_path / "s.onnx").stat().st_size < 7e6
    assert load_segmenter(tmp_path / "s_8bit.onnx").class_names == ("bird",)


@pytest.mark.extended
def test_a_keypoint_network_from_a_base_network_begins_with_its_weights(scenes, tmp_path, monkeypatch):
    monkeypatch.setattr(network_files, "MAX_PICTURES", 20)
    still = QUICK._replace(learning_rate=1e-12)
    train_network("keypoints", tmp_path / "k.onnx", Simulation(scenes, 1), still, base="builtin")
    picture = np.random.default_rng(0).uniform(0, 1, (1, 3, 192, 192)).astype(np.float32)
    networks = [OnnxModel(path) for path in (tmp_path / "k.onnx", base_file("keypoints", "builtin"))]
    np.testing.assert_allclose(*(network(picture)["heatmaps"] for network in networks), atol=2e-3)
    assert networks[0].metadata["background"] == "visible"
    assert load_keypoint_detector(tmp_path / "k.onnx").keypoint_names == MURRE_KEYPOINTS
    assert (tmp_path / "k.onnx").stat().st_size < 4.8e6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenes": 0}, "scenes"),
        ({"schedule": QUICK._replace(steps=3)}, "steps"),
        ({"wings": 2}, "wings"),
        ({}, "holds other files"),
        ({"path": "n.pt"}, ".onnx"),
    ],
)
def test_invalid_arguments_are_rejected(folder, tmp_path, arguments, message):
    path = tmp_path / arguments.pop("path", "n.onnx")
    given = {key: arguments.pop(key) for key in ("scenes", "wings") if key in arguments}
    with pytest.raises(InputError, match=message):
        train_network("segmenter", path, Simulation(folder, **{"scenes": 1, **given}), **arguments)
    assert not path.exists()
