"""A reader of `.glb` files that poses the meshes, written from the glTF 2.0 specification with NumPy and SciPy."""

import json
import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

TYPES = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Glb:
    """A file: its JSON as `root`, and the poses of its skinned meshes at any time."""

    def __init__(self, path: Path):
        content = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", content)
        assert (magic, version, length) == (b"glTF", 2, len(content))
        size, kind = struct.unpack_from("<I4s", content, 12)
        assert kind == b"JSON"
        self.root = json.loads(content[20 : 20 + size])
        binary_size, kind = struct.unpack_from("<I4s", content, 20 + size)
        assert kind == b"BIN\0"
        self.binary = content[28 + size : 28 + size + binary_size]
        self.parent = {c: i for i, node in enumerate(self.root["nodes"]) for c in node.get("children", [])}

    def array(self, index):
        accessor = self.root["accessors"][index]
        view = self.root["bufferViews"][accessor["bufferView"]]
        start, width = view.get("byteOffset", 0) + accessor.get("byteOffset", 0), SIZES[accessor["type"]]
        values = np.frombuffer(self.binary, TYPES[accessor["componentType"]], accessor["count"] * width, start)
        values = values.reshape(accessor["count"], width)
        if "min" in accessor:
            assert np.array_equal(values.min(0), accessor["min"])
            assert np.array_equal(values.max(0), accessor["max"])
        return values

    def sampled(self, time):
        """Node → its animated values at a time."""
        animated = {}
        for animation in self.root["animations"]:
            for channel in animation["channels"]:
                sampler = animation["samplers"][channel["sampler"]]
                times, values = self.array(sampler["input"])[:, 0], self.array(sampler["output"])
                assert (np.diff(times) > 0).all()
                values = values.reshape(len(times), -1)
                path = channel["target"]["path"]
                if path == "rotation":
                    assert np.allclose(np.linalg.norm(values, axis=1), 1, atol=1e-5)
                    assert (np.sum(values[1:] * values[:-1], axis=1) >= 0).all()
                i = int(np.clip(np.searchsorted(times, time + 1e-6, side="right") - 1, 0, len(times) - 1))
                value = values[i]
                if sampler["interpolation"] == "LINEAR" and i + 1 < len(times) and time > times[i]:
                    share = (time - times[i]) / (times[i + 1] - times[i])
                    value = (1 - share) * value + share * values[i + 1]
                animated.setdefault(channel["target"]["node"], {})[path] = value.astype(np.float64)
        return animated

    def matrix(self, node, animated):
        """The global transform of a node."""
        values = self.root["nodes"][node] | animated.get(node, {})
        rotation = Rotation.from_quat(values.get("rotation", [0, 0, 0, 1])).as_matrix()
        own = np.eye(4)
        own[:3, :3] = rotation * np.array(values.get("scale", [1, 1, 1]), float)
        own[:3, 3] = values.get("translation", [0, 0, 0])
        return self.matrix(self.parent[node], animated) @ own if node in self.parent else own

    def posed(self, name, time):
        """Vertices of a skinned mesh at a time, scene coordinates, (V, 3)."""
        animated = self.sampled(time)
        index = next(i for i, node in enumerate(self.root["nodes"]) if node["name"] == name)
        node = self.root["nodes"][index]
        assert index not in self.parent
        mesh, skin = self.root["meshes"][node["mesh"]], self.root["skins"][node["skin"]]
        (primitive,) = mesh["primitives"]
        attributes = primitive["attributes"]
        vertices = self.array(attributes["POSITION"]).astype(np.float64)
        weights = animated.get(index, {}).get("weights", mesh.get("weights", []))
        for weight, target in zip(weights, primitive.get("targets", []), strict=True):
            vertices = vertices + weight * self.array(target["POSITION"])
        joints, shares = self.array(attributes["JOINTS_0"]), self.array(attributes["WEIGHTS_0"]).astype(np.float64)
        assert joints.shape[1] == 4
        assert np.abs(shares.sum(1) - 1).max() < 1e-6
        inverse = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)  # column by column
        matrices = np.stack([self.matrix(j, animated) @ inverse[i] for i, j in enumerate(skin["joints"])])
        homogeneous = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1)
        moved = np.einsum("vkab,vb->vka", matrices[joints], homogeneous)[..., :3]
        return np.sum(shares[..., None] * moved, axis=1)
