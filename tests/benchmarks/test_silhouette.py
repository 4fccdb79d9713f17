"""The raster core's benchmark reports what it promises."""

import numpy as np
import pytest

from jaxfit.benchmarks.silhouette import bench_silhouette, bird_like_mesh, fitted_to_image
from jaxfit.raster import silhouette as raster


def test_generated_bird():
    vertices, faces = bird_like_mesh()
    assert faces.shape == (5712, 3)
    assert set(np.unique(faces)) == set(range(len(vertices)))
    corners = fitted_to_image(vertices, 256)[faces][..., :2]
    (ax, ay), (bx, by) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    depth = np.abs(ax * by - ay * bx).sum() / 2 / raster.silhouette(fitted_to_image(vertices, 256), faces, 256).sum()
    assert 1.5 < depth < 6  # faces over one another, as on a feathered bird


def test_a_mesh_is_fitted_to_the_image():
    box = np.array([[0, 0, 0], [1, 10, 4], [1, 0, 0]], np.float32)
    screen = fitted_to_image(box, 100)
    np.testing.assert_allclose(np.ptp(screen, 0), [28, 70, 0], rtol=1e-5)
    np.testing.assert_allclose((screen.min(0) + screen.max(0)) / 2, [50, 50, 1], rtol=1e-5)


def test_report():
    vertices, faces = bird_like_mesh()
    found = bench_silhouette(frames=4, repeats=1, size=64, vertices=vertices, faces=faces[::50])
    assert (found["frames"], found["faces"], found["size"]) == (4, len(faces[::50]), 64)
    assert found["isa"] == raster.current_isa()
    assert found["threads"] >= 1
    assert 0 <= found["gradient_error"] < 1e-3
    for name in ("ms_per_frame", "loss_ms_per_frame", "matmul_ms", "matmul_ratio"):
        assert found[name] > 0
    assert found["matmul_ratio"] == pytest.approx(found["ms_per_frame"] / found["matmul_ms"])
    rows = {(row["frames"], row["faces"]) for row in found["scaling"]}
    assert rows == {(1, 115), (2, 115), (4, 115), (4, 58), (4, 29)}


def test_wrong_arguments():
    with pytest.raises(ValueError, match="expected both or neither"):
        bench_silhouette(faces=np.zeros((1, 3), int))
    with pytest.raises(ValueError, match="repeats: expected at least 1, got 0"):
        bench_silhouette(repeats=0)
