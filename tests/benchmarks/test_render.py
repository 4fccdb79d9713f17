"""The benchmark of the renderer: its settings and rates."""

import pytest

from jaxfit.evaluation.benchmarks import raster as benchmark
from jaxfit.raster import kernels as native


def test_the_benchmark_reports_its_settings_and_rates(monkeypatch):
    seconds = iter((0.5, 0.25, 2.0, 4.0))

    def run_in_known_time(run, repeats):
        assert repeats == 1
        run()
        return next(seconds)

    monkeypatch.setattr(benchmark, "median_seconds", run_in_known_time)
    result = benchmark.bench_render(crops=2, birds=2, repeats=1)
    assert (result["crops"], result["birds"], result["isa"]) == (2, 2, native.current_isa())
    assert (result["faces"], result["frame_faces"]) == (5712, 5712)
    assert (result["crops_per_s"], result["interpolated_crops_per_s"]) == (4, 8)
    assert (result["full_frames_per_s"], result["full_frame_ms"], result["mask_ms"]) == (0.5, 2e3, 4e3)
    with pytest.raises(ValueError, match="birds: expected at least 1, got 0"):
        benchmark.bench_render(birds=0)
