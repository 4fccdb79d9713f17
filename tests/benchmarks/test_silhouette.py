"""The benchmark of the soft silhouette: its mesh, its measurement of time and its report."""

import itertools

import numpy as np
import pytest

from jaxfit.evaluation.benchmarks import raster as benchmark
from jaxfit.evaluation.benchmarks.raster import bench_silhouette, bird_like_mesh, fitted_to_image
from jaxfit.raster import kernels
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


def test_median_seconds(monkeypatch):
    clock = itertools.accumulate([10.0, 5.0, 0.0, 1.0, 0.0, 3.0])  # three runs, of 5, 1 and 3 seconds
    monkeypatch.setattr(benchmark.time, "perf_counter", lambda: next(clock))
    runs = []
    assert benchmark.median_seconds(lambda: runs.append(len(runs)), 3) == 3
    assert len(runs) == 4  # the first run is not measured


@pytest.mark.extended
def test_report(monkeypatch):
    seconds = iter(range(1, 8))

    def run_in_known_time(run, repeats):
        assert repeats == 1
        run()
        return next(seconds)

    monkeypatch.setattr(benchmark, "median_seconds", run_in_known_time)
    vertices, faces = bird_like_mesh()
    result = bench_silhouette(frames=4, repeats=1, size=64, vertices=vertices, faces=faces[::50])
    assert (result["frames"], result["faces"], result["size"]) == (4, len(faces[::50]), 64)
    assert result["isa"] == kernels.current_isa()
    assert result["threads"] >= 1
    assert 0 <= result["gradient_error"] < 1e-3
    assert (result["ms_per_frame"], result["matmul_ms"], result["loss_ms_per_frame"]) == (1e3 / 4, 2e3, 7e3 / 4)
    assert result["matmul_ratio"] == pytest.approx(1 / 8)
    rows = [(row["frames"], row["faces"], row["ms_per_frame"]) for row in result["scaling"]]
    assert rows == [(1, 115, 3e3), (2, 115, 4e3 / 2), (4, 29, 5e3 / 4), (4, 58, 6e3 / 4), (4, 115, 1e3 / 4)]


def test_wrong_arguments():
    with pytest.raises(ValueError, match="expected both or neither"):
        bench_silhouette(faces=np.zeros((1, 3), int))
    with pytest.raises(ValueError, match="repeats: expected at least 1, got 0"):
        bench_silhouette(repeats=0)
