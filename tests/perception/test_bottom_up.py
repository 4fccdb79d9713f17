"""Bottom-up segmentation, on graphs with known maps."""

import numpy as np
import pytest
from onnx import helper
from support.onnx_graphs import write_constant, write_graph

from jaxfit.foundation.errors import InputError
from jaxfit.perception.network import OnnxModel
from jaxfit.perception.segmentation import BottomUp, load_segmenter

CELLS_HIGH, CELLS_WIDE, CELL_PX = 48, 64, 2  # an input of 128 x 96
FRAME = np.zeros((96, 128, 3), np.uint8)


def maps_of(*birds):
    """Foreground, centre and offset of rectangles in cells: (x0, y0, x1, y1), height of the peak."""
    foreground, centre = np.zeros((2, 1, CELLS_HIGH, CELLS_WIDE), np.float32)
    offset = np.zeros((2, CELLS_HIGH, CELLS_WIDE), np.float32)
    rows, columns = np.indices((CELLS_HIGH, CELLS_WIDE))
    for (x0, y0, x1, y1), peak in birds:
        box = slice(y0, y1), slice(x0, x1)
        middle_x, middle_y = (x0 + x1) // 2, (y0 + y1) // 2
        foreground[0][box], centre[0, middle_y, middle_x] = 1, peak
        offset[0][box] = (middle_x - columns[box]) * CELL_PX / 32
        offset[1][box] = (middle_y - rows[box]) * CELL_PX / 32
    return {"foreground": foreground, "centre": centre, "offset": offset}


def write(path, maps, input_shape=(1, 3, 96, 128), **metadata):
    return write_constant(path, input_shape, maps, {"names": "{0: 'bird'}", **metadata})


def test_two_birds_that_touch(tmp_path):
    # three frame pixels to a pixel of the input, six to a cell
    path = write(tmp_path / "net.onnx", maps_of(((10, 10, 20, 20), 0.9), ((20, 12, 34, 18), 0.8)))
    first, second = load_segmenter(path)(np.zeros((288, 384, 3), np.uint8))
    assert first.label == second.label == "bird"
    assert (first.score, second.score) == pytest.approx((0.9, 0.8))
    # an edge lies where the bilinear map is 0.5: on the border of the cells
    assert first.box_px.tolist() == [60, 60, 60, 60]
    assert first.mask[1:-1, 1:-1].all()
    assert second.box_px.tolist() == [120, 72, 84, 36]


def test_offsets_and_not_distances_assign_cells(tmp_path):
    # the left end of the long bird lies below the centre of the other bird and beyond
    path = write(tmp_path / "net.onnx", maps_of(((10, 8, 20, 18), 0.9), ((2, 18, 58, 22), 0.8)))
    first, second = load_segmenter(path)(np.zeros((96, 128, 3), np.uint8))
    assert first.box_px.tolist() == [20, 16, 20, 20]
    assert second.box_px.tolist() == [4, 36, 112, 8]


def test_occluded_bird_in_two_parts_is_one_instance(tmp_path):
    maps = maps_of(((10, 10, 30, 16), 0.9))
    maps["foreground"][0, :, 18:22] = 0  # an occlusion
    (bird,) = load_segmenter(write(tmp_path / "net.onnx", maps))(np.zeros((96, 128, 3), np.uint8))
    assert bird.box_px.tolist() == [20, 20, 40, 12]
    assert not bird.mask[:, 18:22].any()


def test_far_offsets_and_low_peaks_give_no_instance(tmp_path):
    maps = maps_of(((10, 10, 20, 20), 0.9), ((40, 30, 43, 33), 0.9), ((40, 10, 50, 20), 0.3))
    maps["foreground"][0, 40:46, 2:10] = 1
    maps["offset"][:, 40:46, 2:10] = 3  # 96 pixels right and below: no centre is near
    birds = load_segmenter(write(tmp_path / "net.onnx", maps))(np.zeros((96, 128, 3), np.uint8))
    assert [bird.box_px.tolist() for bird in birds] == [[20, 20, 20, 20]]  # others: too few cells, low score


def test_offsets_of_a_wing_are_followed_to_the_centre(tmp_path):
    """The offset of the wing's tip ends on the wing's root, nearer to the centre of another bird than to its own."""
    maps = maps_of(((6, 20, 16, 30), 0.9), ((38, 24, 48, 34), 0.9))
    maps["foreground"][0, 20:22, 16:46] = 1  # the wing of the left bird reaches above the other bird
    maps["offset"][0, 20:22, 16:46] = -15 * CELL_PX / 32
    maps["offset"][1, 20:22, 16:46] = 0
    maps["offset"][0, 20:22, 16:28] = (11 - np.arange(16, 28)) * CELL_PX / 32
    maps["offset"][1, 20:22, 16:28] = (25 - np.arange(20, 22))[:, None] * CELL_PX / 32
    boxes = [bird.box_px.tolist() for bird in load_segmenter(write(tmp_path / "net.onnx", maps))(FRAME)]
    assert sorted(boxes) == [[12, 40, 80, 20], [76, 48, 20, 20]]


def test_an_offset_that_arrives_is_not_followed(tmp_path):
    """The centre of the occluded bird lies on the bird in front, whose offsets point elsewhere."""
    maps = maps_of(((4, 20, 30, 30), 0.8))
    front = maps_of(((14, 10, 24, 36), 0.9))
    inside = front["foreground"][0] > 0
    for name in ("foreground", "offset"):
        maps[name][..., inside] = front[name][..., inside]
    maps["centre"] = np.maximum(maps["centre"], front["centre"])
    maps["centre"][0, 25, 17], maps["centre"][0, 23, 19] = 0, 0
    maps["centre"][0, 25, 18], maps["centre"][0, 14, 19] = 0.8, 0.9  # offsets end one cell beside the first
    maps["offset"][1][inside] = (14 - np.indices(inside.shape)[0][inside]) * CELL_PX / 32
    birds = load_segmenter(write(tmp_path / "net.onnx", maps))(FRAME)
    assert sorted(bird.box_px.tolist() for bird in birds) == [[8, 40, 52, 20], [28, 20, 20, 52]]


def write_picture_network(path, longer_side):
    """Write a network that returns blue as foreground, green as centre and red as offset."""
    nodes = [
        helper.make_node("AveragePool", ["pictures"], ["cells"], kernel_shape=[2, 2], strides=[2, 2]),
        helper.make_node("Split", ["cells", "one_each"], ["blue", "green", "red"], axis=1),
        helper.make_node("Identity", ["blue"], ["foreground"]),
        helper.make_node("Identity", ["green"], ["centre"]),
        helper.make_node("Concat", ["red", "red"], ["offset"], axis=1),
    ]
    shapes = {"foreground": (1, 1, "h", "w"), "centre": (1, 1, "h", "w"), "offset": (1, 2, "h", "w")}
    constants = {"one_each": np.array([1, 1, 1])}
    metadata = {"longer_side": str(longer_side), "names": "['murre']"}
    return write_graph(path, {"pictures": (1, 3, "height", "width")}, shapes, nodes, constants, metadata)


def test_input_is_as_in_training(tmp_path):
    """Area-averaged, blue-green-red within 0 and 1, in the upper left corner; sides are multiples of 32."""
    frame = np.zeros((200, 288, 3), np.uint8)
    frame[60:120, 60:180, 0] = 255  # columns 20 to 60 of 96, rows 20 to 40
    frame[90, 120, 1] = 255  # a ninth of an input pixel, a quarter of that in a cell: below every threshold
    segmenter = load_segmenter(write_picture_network(tmp_path / "net.onnx", 96))
    assert segmenter(frame) == []
    frame[84:90, 114:120, 1] = 255  # one whole cell in the middle; offsets are 0: distant cells are excluded
    (bird,) = segmenter(frame)
    assert bird.label == "murre"
    assert bird.box_px == pytest.approx([60, 60, 120, 60], abs=1)  # 67 rows stand for 66.7
    assert bird.mask[1:-1, 1:-1].all()


class Counted:
    """A network that stores the widths of its inputs."""

    def __init__(self, model):
        self._model, self.widths = model, []

    def __call__(self, array):
        self.widths.append(array.shape[-1])
        return self._model(array)

    def __getattr__(self, name):
        return getattr(self._model, name)


@pytest.mark.parametrize(
    ("length", "found", "widths"),
    [
        (90, 90, [512]),  # a bird of which nothing is missing: half of the least length of a large bird is 100
        (150, 120, [512, 256]),  # offsets of 0 reach 60 pixels; the bird is too short for the smaller input
        (230, 230, [512, 256, 128]),  # the part of 120 pixels is replaced
    ],
)
def test_large_birds_are_detected_in_smaller_inputs(tmp_path, length, found, widths):
    frame = np.zeros((64, 512, 3), np.uint8)
    frame[10:54, 20 : 20 + length, 0] = 255
    y, x = np.indices((64, 512))
    # one highest cell at every size
    frame[..., 1] = 255 * np.exp(-((x - 20 - length / 2 - 1.3) ** 2 + (y - 33.3) ** 2) / 200)
    segmenter = load_segmenter(write_picture_network(tmp_path / "net.onnx", 512))
    segmenter._model = counted = Counted(segmenter._model)
    (bird,) = segmenter(frame)
    assert bird.mask.shape[1] == pytest.approx(found, abs=8)
    assert counted.widths == widths


def test_variable_sides_are_multiples_of_32(tmp_path):
    segmenter = BottomUp(OnnxModel(write(tmp_path / "n.onnx", maps_of(), (1, 3, "h", "w"), longer_side="864")))
    assert segmenter._input_px((2592, 1520), 864) == (864, 512)
    assert segmenter._input_px((854, 480), 864) == (864, 512)
    assert segmenter._input_px((480, 854), 864) == (512, 864)


@pytest.mark.parametrize(
    ("metadata", "classes", "message"),
    [
        ({"names": "['a', 'b']"}, None, "2 classes"),
        ({}, ["cat"], "lacks cat"),
        ({"longer_side": "850"}, None, "a multiple of 32"),
        ({"min_track_score": "1.5"}, None, "min_track_score"),
    ],
)
def test_invalid_metadata_and_classes(tmp_path, metadata, classes, message):
    path = write(tmp_path / "net.onnx", maps_of(), **metadata)
    with pytest.raises(InputError, match=message):
        load_segmenter(path, classes=classes)
