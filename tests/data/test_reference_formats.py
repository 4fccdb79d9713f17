"""Real files of DeepLabCut and SLEAP: pandas 3.1, sleap-io 0.9 and h5py read the same values."""

import numpy as np
import pytest

from jaxfit.data.formats.recognise import read_observations

# file → size of the images, shape (N, T, K), number of known keypoints, sums of positions and their squares, of
# confidences
REAL = {
    "CollectedData_Pranav.h5": ((640, 480), (1, 116, 4), 464, 161406.057, 46910883.58, 464),
    "CollectedData_Pranav.csv": ((640, 480), (1, 116, 4), 464, 161406.057, 46910883.58, 464),
    "sleap_flies.predictions.slp": ((1024, 1024), (2, 1500, 2), 5754, 5157020.0, 2484913664.0, 4481.159),
    "sleap_flies.analysis.h5": ((1024, 1024), (2, 3000, 13), 76474, 81820585.676, 49312263893.97, 76474),
}


@pytest.mark.parametrize("name", REAL)
def test_values_of_real_files(reference_dir, name):
    size, shape, known, total, squares, confidence = REAL[name]
    observed = read_observations(reference_dir / "formats" / name, size_px=size)
    points = observed.keypoints_px.astype(np.float64)
    assert observed.confidence.shape == shape
    assert (observed.confidence > 0).sum() == known
    np.testing.assert_allclose(points.sum(), total, rtol=1e-7)
    np.testing.assert_allclose((points**2).sum(), squares, rtol=1e-6)
    np.testing.assert_allclose(observed.confidence.sum(dtype=np.float64), confidence, rtol=1e-6)


def test_single_values_of_real_files(reference_dir):
    mouse = read_observations(reference_dir / "formats" / "CollectedData_Pranav.h5", size_px=(640, 480))
    assert mouse.keypoint_names == ("snout", "leftear", "rightear", "tailbase")
    assert mouse.file_name[-1] == "labeled-data/m4s1/img0115.png"
    np.testing.assert_allclose(mouse.keypoints_px[0, 2, 3], [99.408, 256.205], rtol=1e-6)
    flies = read_observations(reference_dir / "formats" / "sleap_flies.predictions.slp", size_px=(1024, 1024))
    assert flies.keypoint_names == ("head", "thorax")
    assert flies.skeleton == ((1, 0),)
    np.testing.assert_allclose(flies.keypoints_px[1, 0, 0], [332.74493408, 444.57592773], rtol=1e-6)
    np.testing.assert_allclose(flies.confidence[:, 0], [[0.40677679, 0.97006315], [1, 0.9660179]], rtol=1e-6)
