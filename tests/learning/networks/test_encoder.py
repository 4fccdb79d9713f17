"""The encoder of the segmenter: weights of a file, layers that a training keeps."""

import copy

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `train` (PyTorch)")

from torch import nn  # noqa: E402
from torch.nn.utils.fusion import fuse_conv_bn_eval  # noqa: E402

from jaxfit.foundation.errors import InputError  # noqa: E402
from jaxfit.learning.networks.networks import (  # noqa: E402
    FeaturePyramid,
    efficientnet_stages,
    load_photograph_weights,
)
from jaxfit.learning.networks.segmenter import FIXED_STAGES, segmenter_network  # noqa: E402


@pytest.fixture(scope="module")
def segmenter():
    torch.manual_seed(0)
    return segmenter_network()


def published_weights(encoder):
    """Return weights in the order of the published file, and give the encoder the same weights, folded by hand."""
    stored = {}
    for n, layer in enumerate(layer for layer in encoder.modules() if isinstance(layer, nn.Conv2d)):
        norm = nn.BatchNorm2d(layer.out_channels, eps=1e-3)
        nn.init.uniform_(norm.weight, 0.5, 2)
        nn.init.normal_(norm.bias)
        nn.init.normal_(norm.running_mean)
        nn.init.uniform_(norm.running_var, 0.5, 2)
        bare = copy.deepcopy(layer)
        bare.bias = None
        folded = fuse_conv_bn_eval(bare.eval(), norm.eval())
        stored[f"conv{n}.weight"] = bare.weight.detach().clone()
        stored |= {f"norm{n}.{name}": value for name, value in norm.state_dict().items()}
        layer.weight, layer.bias = folded.weight, folded.bias
    return stored


def test_weights_of_photographs_are_read_for_blue_green_red(tmp_path):
    torch.manual_seed(1)
    published, own = nn.Sequential(*efficientnet_stages()), nn.Sequential(*efficientnet_stages())
    torch.save({**published_weights(published), "_fc.weight": torch.zeros(3, 5)}, tmp_path / "weights.pth")
    load_photograph_weights(own, tmp_path / "weights.pth")
    picture = torch.rand(1, 3, 64, 96)
    with torch.inference_mode():
        expected, found = published(picture.flip(1)), own(picture)
        first, swapped = published[0](picture.flip(1)), own[0](picture.flip(1))
    assert expected.shape == (1, 320, 2, 3)
    assert expected.std() > 0
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4 * float(expected.abs().max()))
    assert (swapped - first).abs().max() > 1e-2 * first.abs().max()


def test_files_of_other_weights_are_rejected(tmp_path, segmenter):
    with pytest.raises(InputError, match=r"absent\.pth: does not exist"):
        load_photograph_weights(segmenter.down, tmp_path / "absent.pth")
    (tmp_path / "text.pth").write_text("no weights")
    with pytest.raises(InputError, match=r"text\.pth: is not a readable file of weights"):
        load_photograph_weights(segmenter.down, tmp_path / "text.pth")
    torch.save({"a": torch.zeros(3)}, tmp_path / "other.pth")
    with pytest.raises(InputError, match=r"other\.pth: holds the weights of another network"):
        load_photograph_weights(segmenter.down, tmp_path / "other.pth")


def test_a_file_with_code_is_not_executed(tmp_path, segmenter):
    class Code:
        def __reduce__(self):
            return (np.save, (str(tmp_path / "executed.npy"), np.zeros(1)))

    torch.save({"down": Code()}, tmp_path / "code.pth")
    with pytest.raises(InputError, match="is not a readable file of weights"):
        load_photograph_weights(segmenter.down, tmp_path / "code.pth")
    assert not (tmp_path / "executed.npy").exists()


def test_a_training_keeps_the_first_stages(segmenter):
    before = {name: value.clone() for name, value in segmenter.down.state_dict().items()}
    optimiser = torch.optim.SGD(segmenter.parameters(), lr=1e-3)
    segmenter.train()
    maps = segmenter(torch.rand(1, 3, 64, 64))
    torch.stack([values.square().mean() for values in maps.values()]).sum().backward()
    optimiser.step()
    changed = {name for name, value in segmenter.down.state_dict().items() if not torch.equal(value, before[name])}
    assert {int(name.split(".")[0]) for name in changed} == set(range(FIXED_STAGES, 5))


def test_the_encoder_has_a_smaller_learning_rate():
    stage = nn.Sequential(nn.Conv2d(3, 4, 3, 2, 1))
    other = nn.Sequential(nn.Conv2d(4, 4, 3, 2, 1))
    network = FeaturePyramid([stage, other], (4, 4), (4,), {"a": 1}, encoder_rate=0.1)
    groups = network.parameter_groups()
    assert [group["share"] for group in groups] == [0.1, 1.0]
    assert {id(p) for p in groups[0]["params"]} == {id(p) for p in network.down.parameters()}
    assert sum(len(group["params"]) for group in groups) == len(list(network.parameters()))
