"""Small ONNX networks with the layouts of YOLOX and U²-Net: a bird in a known box, and the saliency of red pixels."""

import numpy as np
from onnx import helper

from support.onnx_graphs import write_graph, write_reading

FIRST_OF_STRIDE_16, FIRST_OF_STRIDE_32 = 52 * 52, 52 * 52 + 26 * 26


def yolox_head(*rows):
    """Rows of cell, four box values, objectness, class, its probability."""
    head = np.zeros((1, 3549, 85), np.float32)
    for cell, box, objectness, label, probability in rows:
        head[0, cell, :4], head[0, cell, 4], head[0, cell, 5 + label] = box, objectness, probability
    return head


def write_yolox(path, head, read=None):
    return write_reading(path, (1, 3, 416, 416), {"output": head}, read or {})


def write_saliency(path):
    """The saliency is the first channel of the input; a second output is its negative."""
    nodes = [
        helper.make_node("Gather", ["input.1", "zero"], ["1959"], axis=1),
        helper.make_node("Neg", ["1959"], ["1960"]),
    ]
    shape = (1, 1, 320, 320)
    outputs = {"1959": shape, "1960": shape}
    return write_graph(path, {"input.1": (1, 3, 320, 320)}, outputs, nodes, {"zero": np.array([0])})


# in column 10, row 7 of stride 16: centre (168, 116), size (64, 32) of the input; twice that in a frame of 832 x 416
BIRD_ROW = (FIRST_OF_STRIDE_16 + 7 * 26 + 10, (0.5, 0.25, np.log(4), np.log(2)), 0.8, 14, 0.9)
BIRD_BOX = [272, 200, 400, 264]
