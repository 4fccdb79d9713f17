"""Keypoint networks of every supported layout, on graphs with known outputs; and unsupported networks."""

import numpy as np
import pytest
from onnx import TensorProto, helper
from support.instances import rectangle_instance
from support.onnx_graphs import write_constant, write_graph

from jaxfit.foundation.errors import InputError
from jaxfit.model.anatomy import MURRE_KEYPOINTS
from jaxfit.perception.keypoints import load_keypoint_detector

FRAME = np.zeros((300, 400, 3), np.uint8)
CORNER_PX = np.array([100, 60])
NAMES = ("bill_tip", "tail_tip", "nape")
PLAIN = {"keypoint_names": ",".join(NAMES), "mean": "0", "std": "255"}


UNSCALED = rectangle_instance(*CORNER_PX, 32, 64)
"""For a network of 32 × 64 pixels, its crop without a margin is the frame from CORNER_PX on, pixel by pixel."""


def _detect(path, instances=(UNSCALED,), **options):
    return load_keypoint_detector(path, pad_px=0, **options)(FRAME, instances)


def _spots(points, sigma=1.2, heights=(0.9, 0.6, 0.3)):
    """Heatmaps (3, 16, 8) whose peaks lie at points in cells, the first cell's centre at 0."""
    y, x = np.mgrid[:16, :8]
    return np.stack(
        [
            h * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * sigma**2))
            for (px, py), h in zip(points, heights, strict=True)
        ]
    )


CELLS = np.array([[2.25, 3.0], [5.0, 9.75], [6.0, 12.4]])


@pytest.mark.parametrize(
    ("alignment", "expected"),
    [
        (None, 4 * (CELLS + 0.5)),
        ("centres", 4 * (CELLS + 0.5)),
        ("deeplabcut", 4 * (CELLS + 0.5) + 0.5),
        ("msra", 4 * CELLS + 0.5),
        ("udp", CELLS * [31 / 7, 63 / 15] + 0.5),
    ],
)
def test_heatmaps(tmp_path, alignment, expected):
    metadata = PLAIN | ({"alignment": alignment} if alignment else {})
    path = write_constant(tmp_path / "k.onnx", ("n", 3, 64, 32), {"heatmaps": _spots(CELLS)}, metadata)
    points, confidence = _detect(path)
    assert points.dtype == confidence.dtype == np.float32
    np.testing.assert_allclose(points[0], expected + CORNER_PX, atol=1e-3)
    whole = np.round(CELLS)
    lower = np.exp(-((CELLS - whole) ** 2).sum(-1) / (2 * 1.2**2))  # the largest cell is not the peak
    np.testing.assert_allclose(confidence[0], [0.9, 0.6, 0.3] * lower, rtol=1e-5)


def test_heatmaps_with_the_channels_last(tmp_path):
    heatmaps = {"heatmaps": _spots(CELLS).transpose(1, 2, 0)}
    points = {}
    for shape in ((None, 64, 32, 3), (None, 3, 64, 32)):
        points[shape] = _detect(write_constant(tmp_path / "k.onnx", shape, heatmaps, PLAIN))[0]
        np.testing.assert_allclose(points[shape][0], 4 * (CELLS + 0.5) + CORNER_PX, atol=1e-3)


def _located(channels_last=False):
    """Stride 8: cells (1, 2), (3, 7), (0, 0), offsets (1, −0.5), (−0.25, 0), (0.5, 0.125) in standard deviations."""
    heatmaps, locref = np.full((3, 8, 4), 0.1), np.full((6, 8, 4), 9.0)
    for k, (x, y, dx, dy) in enumerate([(1, 2, 1, -0.5), (3, 7, -0.25, 0), (0, 0, 0.5, 0.125)]):
        heatmaps[k, y, x] = 0.5 + 0.4 * k
        locref[2 * k : 2 * k + 2, y, x] = dx, dy
    if channels_last:
        heatmaps, locref = heatmaps.transpose(1, 2, 0), locref.transpose(1, 2, 0)
    return {"heatmap": heatmaps, "locref": locref}


@pytest.mark.parametrize("channels_last", [False, True])
@pytest.mark.parametrize("turned", [False, True])
def test_offsets_with_channels_first_and_last(tmp_path, channels_last, turned):
    outputs = _located(channels_last)
    outputs = dict(reversed(outputs.items())) if turned else outputs
    shape = (1, 64, 32, 3) if channels_last else (1, 3, 64, 32)
    points, confidence = _detect(write_constant(tmp_path / "k.onnx", shape, outputs, PLAIN))
    # (cell + 1/2) · 8 + offset · 7.2801, plus 1/2 because DeepLabCut's pixel centres have integer coordinates
    expected = np.array([[12 + 7.2801, 20 - 3.64005], [28 - 1.820025, 60], [4 + 3.64005, 4 + 0.9100125]]) + 0.5
    np.testing.assert_allclose(points[0], expected + CORNER_PX, atol=1e-4)
    np.testing.assert_allclose(confidence[0], [0.5, 0.9, 1.0])


def test_scaled_offsets_and_ignored_offsets(tmp_path):
    metadata = PLAIN | {"locref_std": "2", "alignment": "centres", "activation": "sigmoid"}
    path = write_constant(tmp_path / "k.onnx", (1, 3, 64, 32), _located(), metadata)
    points, confidence = _detect(path)
    np.testing.assert_allclose(points[0, 0], [100 + 12 + 2, 60 + 20 - 1], atol=1e-4)
    np.testing.assert_allclose(confidence[0], 1 / (1 + np.exp([-0.5, -0.9, -1.3])), rtol=1e-5)
    ignored, _ = _detect(path, kind="heatmap")
    assert ignored[0, 0].tolist() == [112, 80]


def test_simcc(tmp_path):
    x, y = np.full((3, 64), -0.5), np.full((3, 128), -0.5)
    for k, (i, j) in enumerate([(0, 127), (31, 64), (63, 1)]):
        x[k, i], y[k, j] = [(0.4, 0.7), (1.5, 1.2), (0.8, -0.1)][k]
    path = write_constant(tmp_path / "k.onnx", ("batch", 3, 64, 32), {"simcc_y": y, "simcc_x": x}, PLAIN)
    points, confidence = _detect(path)
    expected = np.array([[0, 63.5], [15.5, 32], [31.5, 0.5]]) + 0.5
    np.testing.assert_allclose(points[0], expected + CORNER_PX)
    np.testing.assert_allclose(confidence[0], [0.4, 1.0, 0.0])
    unnamed = write_constant(tmp_path / "u.onnx", ("batch", 3, 64, 32), {"a": x, "b": y}, PLAIN)
    np.testing.assert_array_equal(_detect(unnamed, kind="simcc")[0], points)


def test_values_that_are_not_finite_get_no_confidence(tmp_path):
    for layout in ["heatmaps", "locref", "simcc"]:
        for value in [np.nan, np.inf, -np.inf]:
            outputs = {
                "heatmaps": {"heatmaps": _spots(CELLS)},
                "locref": _located(),
                "simcc": {"simcc_x": np.ones((3, 64)), "simcc_y": np.ones((3, 128))},
            }[layout]
            for output in outputs.values():
                output[1].flat[-1] = value
            if layout == "locref":
                outputs["locref"][2, 7, 3] = value  # the offset of the second keypoint
            points, confidence = _detect(write_constant(tmp_path / "k.onnx", (1, 3, 64, 32), outputs, PLAIN))
            assert np.isfinite(points).all()
            assert confidence[0, 1] == 0
            assert (confidence[0, [0, 2]] > 0.2).all()


def _write_pooling(path, batch, metadata, size=(192, 144), channels_last=False, kind=TensorProto.FLOAT):
    """The heatmaps are the channels of the picture, averaged over 4 × 4 pixels."""
    picture, maps = (batch, 3, *size), (batch, 3, None, None)
    nodes = [helper.make_node("AveragePool", ["numbers"], ["pooled"], kernel_shape=[4, 4], strides=[4, 4])]
    if channels_last:
        picture, maps = (batch, *size, 3), (batch, None, None, 3)
        nodes.insert(0, helper.make_node("Transpose", ["floats"], ["numbers"], perm=[0, 3, 1, 2]))
        nodes.append(helper.make_node("Transpose", ["pooled"], ["heatmaps"], perm=[0, 2, 3, 1]))
    else:
        nodes.insert(0, helper.make_node("Identity", ["floats"], ["numbers"]))
        nodes.append(helper.make_node("Identity", ["pooled"], ["heatmaps"]))
    nodes.insert(0, helper.make_node("Cast", ["input"], ["floats"], to=TensorProto.FLOAT))
    return write_graph(path, {"input": picture}, {"heatmaps": maps}, nodes, metadata=metadata, kind=kind)


def _scene():
    """Three birds, one of them at the border, with three coloured spots: frame, birds, points of red, green, blue."""
    points = np.array(
        [
            [[60.3, 70.8], [131.0, 52.4], [150.7, 101.1]],
            [[283.5, 160.2], [300.9, 210.6], [322.1, 190.0]],
            [[12.4, 250.3], [30.6, 220.1], [61.2, 262.9]],
        ]
    )
    y, x = np.mgrid[:300, :400] + 0.5
    frame = np.zeros((300, 400, 3))
    for bird in points:
        for k, (px, py) in enumerate(bird):
            frame[..., 2 - k] += 220 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * 6.0**2))
    boxes = [(40, 35, 130, 85), (265, 140, 75, 90), (0, 205, 75, 80)]
    birds = [rectangle_instance(*box) for box in boxes]
    return np.round(frame).astype(np.uint8), birds, points


def test_points_are_in_image_pixels(tmp_path):
    for colour in ["rgb", "bgr"]:
        for batch in ["n", 1, 2]:
            frame, birds, points = _scene()
            path = _write_pooling(tmp_path / "k.onnx", batch, PLAIN | {"colour": colour})
            found, confidence = load_keypoint_detector(path, batch=2)(frame, birds)
            expected = points if colour == "rgb" else points[:, ::-1]
            np.testing.assert_allclose(found, expected, atol=0.15)
            assert ((confidence > 0.65) & (confidence < 0.87)).all()


def test_other_kinds_of_input(tmp_path):
    frame, birds, points = _scene()
    last = _write_pooling(tmp_path / "a.onnx", "n", {"keypoint_names": "a,b,c"}, channels_last=True)
    octets = _write_pooling(tmp_path / "b.onnx", "n", {"keypoint_names": "a,b,c"}, kind=TensorProto.UINT8)
    free = _write_pooling(tmp_path / "c.onnx", "n", PLAIN, ("h", "w"))
    told = _write_pooling(tmp_path / "d.onnx", "n", PLAIN | {"input_size": "144,192"}, ("h", "w"))
    for path in (last, octets, free, told):
        found, _ = load_keypoint_detector(path)(frame, birds)
        np.testing.assert_allclose(found, points, atol=0.15)


@pytest.mark.parametrize(
    ("metadata", "expected"),
    [
        ({}, np.array([123.675, 116.28, 103.53]) / [58.395, 57.12, 57.375]),
        ({"colour": "bgr"}, np.array([103.53, 116.28, 123.675]) / [57.375, 57.12, 58.395]),
        ({"mean": "10,20,30", "std": "100,50,200"}, [0.1, 0.4, 0.15]),
        ({"mean": "51", "std": "255"}, [0.2, 0.2, 0.2]),
    ],
)
def test_normalisation(tmp_path, metadata, expected):
    """The confidence is −1/4 of the normalised value of black, −mean / std."""
    shape = ("n", 3, 8, 8)
    node = helper.make_node("Mul", ["input", "factor"], ["heatmaps"])
    constants = {"factor": np.array(-0.25, np.float32)}
    path = write_graph(tmp_path / "k.onnx", {"input": shape}, {"heatmaps": shape}, [node], constants, metadata)
    _, confidence = load_keypoint_detector(path, names=NAMES)(FRAME, [UNSCALED])
    np.testing.assert_allclose(confidence[0], np.array(expected) / 4, rtol=1e-5)


def test_crop_parameters_come_from_the_metadata(tmp_path):
    x, y = np.zeros((3, 64)), np.zeros((3, 64))
    for metadata, options, x0 in (({}, {}, -40), ({"pad_px": "16"}, {}, -16), ({"pad_px": "16"}, {"pad_px": 8}, -8)):
        path = write_constant(tmp_path / "k.onnx", (1, 3, 64, 64), {"simcc_x": x, "simcc_y": y}, PLAIN | metadata)
        points, _ = load_keypoint_detector(path, **options)(FRAME, [rectangle_instance(100, 100, 64, 64)])
        scale = (64 - 2 * x0) / 64
        np.testing.assert_allclose(points[0], 100 + x0 + 0.5 * scale)


def test_visible_background_hides_the_other_birds(tmp_path):
    """Under a neighbour that covers the whole crop, only the bird's own mask is visible."""
    shape = ("n", 3, 8, 8)
    node = helper.make_node("Mul", ["input", "factor"], ["heatmaps"])
    metadata = PLAIN | {"mean": "0", "std": "255", "background": "visible", "pad_px": "4", "dilate_px": "0"}
    path = write_graph(
        tmp_path / "k.onnx",
        {"input": shape},
        {"heatmaps": shape},
        [node],
        {"factor": np.array(1.0, np.float32)},
        metadata,
    )
    frame = np.full((64, 64, 3), 255, np.uint8)
    birds = [rectangle_instance(20, 20, 8, 8), rectangle_instance(0, 0, 64, 64)]
    _, alone = load_keypoint_detector(path)(frame, birds[:1])
    _, both = load_keypoint_detector(path)(frame, birds)
    assert alone.max() == 1
    picture, _ = load_keypoint_detector(path).network_input(frame, birds, [0])
    assert picture[0, 0].sum() == 16  # the own mask of 4 × 4 pixels, half the crop
    picture, _ = load_keypoint_detector(path, background="black").network_input(frame, birds, [0])
    assert picture[0, 0].sum() == 16
    picture, _ = load_keypoint_detector(path).network_input(frame, birds[:1], [0])
    assert picture[0, 0].sum() == 64
    assert both.shape == (2, 3)


def test_no_birds(tmp_path):
    path = write_constant(tmp_path / "k.onnx", (1, 3, 64, 32), {"heatmaps": _spots(CELLS)}, PLAIN)
    points, confidence = _detect(path, [])
    assert points.shape == (0, 3, 2)
    assert confidence.shape == (0, 3)


def test_names(tmp_path):
    bare = write_constant(tmp_path / "k.onnx", (1, 3, 64, 32), {"heatmaps": _spots(CELLS)})
    murre = write_constant(tmp_path / "m.onnx", (1, 3, 64, 32), {"heatmaps": np.zeros((20, 16, 8))})
    assert load_keypoint_detector(bare, names=NAMES).keypoint_names == NAMES
    assert load_keypoint_detector(murre, names="murre").keypoint_names == MURRE_KEYPOINTS
    for path, names, message in (
        (bare, None, "does not name its 3 keypoints .*`murre` \\(20\\)"),
        (bare, ("a", "b"), "has 3 keypoints, but 2 names are given"),
        (murre, "aves", "has 20 keypoints, but 18 names are given"),
        (bare, "gull", "is not a set of keypoint names .*`aves` \\(18\\)"),
    ):
        with pytest.raises(InputError, match=message):
            load_keypoint_detector(path, names=names)


@pytest.mark.parametrize(
    ("shape", "outputs", "kind", "message"),
    [
        (
            (1, 1, 64, 32),
            {"heatmaps": (3, 16, 8)},
            "auto",
            r"no input for colour pictures: input \(1, 1, 64, 32\)",
        ),
        ((1, 3, 64, 32), {"points": (3, 2)}, "auto", r"points \(1, 3, 2\).*supported are heatmaps"),
        ((1, 3, 64, 32), {"heatmaps": (3, 16, 30)}, "auto", r"heatmaps \(1, 3, 16, 30\)"),
        ((1, 3, 64, 32), {"a": (3, 16, 8), "b": (3, 16, 8)}, "auto", "not a supported keypoint network"),
        ((1, 3, 64, 32), {"heatmaps": (3, 16, 8)}, "simcc", "not a supported keypoint network of kind `simcc`"),
        ((1, 3, 64, 32), {"simcc_x": (3, 64), "simcc_y": (4, 128)}, "auto", "simcc_y"),
        ((1, 3, 64, 32), {"heatmaps": (3, 16, 8)}, "yolo", "yolo: is not a kind .*auto, heatmap, deeplabcut, simcc"),
    ],
)
def test_unsupported_layouts(tmp_path, shape, outputs, kind, message):
    path = write_constant(tmp_path / "k.onnx", shape, {name: np.zeros(side) for name, side in outputs.items()})
    with pytest.raises(InputError, match=message):
        load_keypoint_detector(path, kind=kind, names=NAMES)


@pytest.mark.parametrize(
    ("key", "text", "remedy"),
    [
        ("mean", "1,2", "Field required"),
        ("std", "0", "greater than 0"),
        ("colour", "grey", "'rgb' or 'bgr'"),
        ("input_size", "0,64", "greater than 0"),
        ("pad_px", "-3", "greater than or equal to 0"),
        ("keypoint_names", "a,,c", "at least 1 character"),
    ],
)
def test_invalid_metadata(tmp_path, key, text, remedy):
    path = write_constant(tmp_path / "k.onnx", (1, 3, 64, 32), {"heatmaps": _spots(CELLS)}, PLAIN | {key: text})
    with pytest.raises(InputError, match=f"`{key}` is '{text}' .*{remedy}"):
        load_keypoint_detector(path)


def test_unsupported_element_type(tmp_path):
    path = write_constant(
        tmp_path / "k.onnx", (1, 3, 64, 32), {"heatmaps": _spots(CELLS)}, PLAIN, kind=TensorProto.INT64
    )
    with pytest.raises(InputError, match=r"has an input of type tensor\(int64\) .*tensor\(float\)"):
        load_keypoint_detector(path)
