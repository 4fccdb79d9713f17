"""Agreement with PyTorch3D's soft silhouette, for both backends and every instruction set."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfit import silhouette as raster

CASES = ("triangle", "triangle_edge_of_frame", "icosphere", "aves_template_a", "aves_template_b", "avian_mesh_a")
SMALL = CASES[:3]  # the reference takes ten seconds for a bird's loss and gradient, so one bird stands for all
CENTRE = 128


@pytest.fixture(params=["avx512", "avx2", "baseline"])
def each_isa(request):
    """Runs the test once an instruction set."""
    if request.param not in raster.available_isas():
        pytest.skip(f"no {request.param} kernels here: {raster.available_isas()}")
    raster.choose_isa(request.param)
    yield request.param
    raster.choose_isa("auto")


@pytest.fixture(scope="module")
def data(reference_dir):
    with np.load(reference_dir / "reference" / "pytorch3d_silhouette.npz") as file:
        return dict(file)


def project(vertices_cam, focal):
    return jnp.concatenate([focal * vertices_cam[:, :2] / vertices_cam[:, 2:] + CENTRE, vertices_cam[:, 2:]], 1)


def relative_error(found, expected):
    return np.linalg.norm(np.asarray(found, np.float64) - expected) / np.linalg.norm(expected)


def check(data, case, backend):
    vertices, faces, target, expected, loss, gradient = (
        data[f"{case}/{name}"] for name in ("vertices", "faces", "target", "silhouette", "loss", "grad_vertices")
    )

    def loss_of(vertices):
        return raster.mask_loss(project(vertices, data["focal"]), faces, target, backend=backend)

    found_loss, found_gradient = jax.jit(jax.value_and_grad(loss_of))(vertices)
    assert found_loss == pytest.approx(float(loss), rel=1e-5)
    assert relative_error(found_gradient, gradient) < 1e-4

    def image_of(vertices):
        return raster.silhouette(project(vertices, data["focal"]), faces, 256, backend=backend)

    image, pull = jax.vjp(jax.jit(image_of), jnp.asarray(vertices))
    np.testing.assert_allclose(image, expected, atol=1e-4)
    if backend == "native" or case in SMALL:
        # The loss once more, by way of the image: this is the kernel that takes a cotangent image.
        (by_image,) = pull(jnp.sign(image - target))
        assert relative_error(by_image, gradient) < 1e-4


@pytest.mark.parametrize("case", CASES)
def test_kernels_agree_with_pytorch3d(data, case, each_isa):
    check(data, case, "native")


@pytest.mark.parametrize("case", [*SMALL, "aves_template_a"])
def test_reference_agrees_with_pytorch3d(data, case):
    check(data, case, "reference")


def test_default_blur_is_that_of_the_data(data):
    blur = raster.Blur.for_size(256)
    assert blur.sigma == pytest.approx(float(data["sigma"]) * 128**2)
    assert blur.radius == pytest.approx(128 * float(data["blur_radius"]) ** 0.5)
