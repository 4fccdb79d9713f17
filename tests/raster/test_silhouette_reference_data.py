"""Agreement with PyTorch3D's soft silhouette, for both backends and every instruction set."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfit.raster import kernels, silhouette_reference
from jaxfit.raster import silhouette as raster

pytestmark = pytest.mark.usefixtures("optimised")

CASES = ("triangle", "triangle_edge_of_frame", "icosphere", "aves_template_a", "aves_template_b", "avian_mesh_a")
SMALL = CASES[:3]
SLOW = pytest.param("aves_template_a", marks=pytest.mark.extended)  # 20 s, so one bird stands for all
CENTRE = 128


@pytest.fixture(params=["avx512", "avx2", "baseline"])
def each_isa(request):
    """Runs the test once for each instruction set."""
    if request.param not in kernels.available_isas():
        pytest.skip(f"no {request.param} kernels here: {kernels.available_isas()}")
    kernels.choose_isa(request.param)
    yield request.param
    kernels.choose_isa("auto")


@pytest.fixture(scope="module")
def data(reference_dir):
    with np.load(reference_dir / "reference" / "pytorch3d_silhouette.npz") as file:
        return dict(file)


def project(vertices_cam, focal):
    return jnp.concatenate([focal * vertices_cam[:, :2] / vertices_cam[:, 2:] + CENTRE, vertices_cam[:, 2:]], 1)


def relative_error(actual, expected):
    return np.linalg.norm(np.asarray(actual, np.float64) - expected) / np.linalg.norm(expected)


# Compiled once for each mesh size and backend.
@functools.partial(jax.jit, static_argnames="backend")
def loss_and_gradient(vertices, faces, target, focal, backend):
    def loss_of(vertices):
        return raster.mask_loss(project(vertices, focal), faces, target, backend=backend)

    return jax.value_and_grad(loss_of)(vertices)


@functools.partial(jax.jit, static_argnames="backend")
def image_and_gradient(vertices, faces, target, focal, backend):
    """The image, and the gradient of the loss through the image: by the kernel that takes a cotangent image."""
    image, pull = jax.vjp(
        lambda v: raster.silhouette(project(v, focal), faces, target.shape[0], backend=backend), vertices
    )
    return image, pull(jnp.sign(image - target))[0]


def check(data, case, backend):
    vertices, faces, target, expected, loss, gradient = (
        data[f"{case}/{name}"] for name in ("vertices", "faces", "target", "silhouette", "loss", "grad_vertices")
    )
    actual_loss, actual_gradient = loss_and_gradient(vertices, faces, target, data["focal"], backend)
    assert actual_loss == pytest.approx(float(loss), rel=1e-5)
    assert relative_error(actual_gradient, gradient) < 1e-4
    if backend == "native" or case in SMALL:
        image, image_gradient = image_and_gradient(vertices, faces, target, data["focal"], backend)
        assert relative_error(image_gradient, gradient) < 1e-4
    else:
        image = raster.silhouette(project(vertices, data["focal"]), faces, len(target), backend=backend)
    np.testing.assert_allclose(image, expected, atol=1e-4)


def test_kernels_agree_with_pytorch3d(data, each_isa):
    for case in CASES:
        check(data, case, "native")


@pytest.mark.parametrize("case", [*SMALL, SLOW])
def test_reference_agrees_with_pytorch3d(data, case):
    check(data, case, "reference")


def test_default_blur_is_that_of_the_data(data):
    blur = silhouette_reference.Blur.for_size(256)
    assert blur.sigma == pytest.approx(float(data["sigma"]) * 128**2)
    assert blur.radius == pytest.approx(128 * float(data["blur_radius"]) ** 0.5)
