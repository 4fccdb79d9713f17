"""Differentiable soft silhouette and mask loss: the public operations and their gradients."""

import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxfit.raster import kernels, silhouette_reference
from jaxfit.raster.silhouette_reference import Blur, Skin

Backend = Literal["auto", "native", "reference"]
Kind = Literal["l1", "smooth_l1"]
Target = Bool[Array, "size size"] | UInt8[Array, "size size"] | Float[Array, "size size"]

_BACKENDS = ("auto", "native", "reference")


def silhouette(
    vertices_screen: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    size: int,
    *,
    blur: Blur | None = None,
    backend: Backend = "auto",
) -> Float[Array, "{size} {size}"]:
    """Return the silhouette of a triangle mesh with a soft edge in a square image.

    With the edge `soft_rasterizer`, S = 1 − Π_f (1 − sigmoid(−d_f / s)) over every face f that contains the pixel's
    centre or is closer to the centre than the blur radius. d_f is the squared distance in px² to the nearest edge,
    negative inside.

    Skipped are faces with |2·area| ≤ 1e-8 (size/2)² px², with two equal corners, or with a vertex at a depth of 1e-8 or
    less.

    With the edge `unbiased`, S = G * min(1, max(F, B)). F is the mean number, over the area of a pixel, of the faces
    whose corners turn from +x to +y; B is the same for the other faces. G is a Gaussian of variance 2·ln(2)·s px².
    Pixels outside the image are 0. The sum of S is the area of the mesh, where no two outlines share a pixel.

    If any coordinate of any vertex is NaN or infinite, the whole image and its gradient are NaN. Coordinates
    beyond ±2²⁰ px are clamped. The kernels stop evaluating a block of pixels when all its S are within 1e-5 of 1.

    Args:
        vertices_screen: x and y in pixels (x right, y down, pixel centres at i + 0.5), and depth in the camera frame
            in any unit. The gradient with respect to depth is 0.
        faces: vertex indices, in any orientation.
        size: width and height of the image in pixels.
        blur: softness, radius and kind of the edge. The default is `Blur.for_size(size)`.
        backend: "native" runs the compiled kernels and "reference" runs plain JAX. "auto" runs the kernels if they are
            built and the platform is the CPU, and otherwise the reference.

    Returns:
        S in [0, 1], row-major: `image[row, column]`.

    Raises:
        ValueError: the shape, type or value of an argument is not as described.
        RuntimeError: backend="native" without kernels.

    Source: Liu et al., "Soft Rasterizer" (2019), eqs. 1 and 4, as computed by PyTorch3D without a limit on the number
    of faces per pixel.
    """
    _check_mesh(vertices_screen, faces)
    _check_size(size)
    blur = Blur.for_size(size) if blur is None else blur
    vertices, faces = _as_operands(vertices_screen, faces)
    image: Any = _silhouette(vertices, faces, int(size), blur, _choose(backend))
    return image.astype(vertices_screen.dtype)


def mask_loss(
    vertices_screen: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    target: Target,
    weight: Float[Array, ""] | float = 1.0,
    *,
    kind: Kind = "l1",
    blur: Blur | None = None,
    backend: Backend = "auto",
) -> Float[Array, ""]:
    """Return the difference between the silhouette of a mesh and a mask, summed over the pixels.

    L = w · Σ ρ(S − target) over the known pixels. With the edge `unbiased`, the coverage C = min(1, max(F, B)) and the
    mask are filtered together: L = w · Σ ρ(G * (C − target)) over all pixels; the difference is 0 where unknown.
    For "l1", ρ(e) = |e|. For "smooth_l1", ρ(e) = e²/2 if |e| < 1, else |e| − 1/2.

    The loss is differentiable in reverse mode with respect to the weight and to x and y of the vertices. The target is
    a constant. One pass of the kernel computes loss and gradient. Without differentiation it computes only the loss.

    Args:
        vertices_screen: as for `silhouette`.
        faces: as for `silhouette`.
        target: a square image of floats in [0, 1], of bool, or of uint8: 0 is outside, `UNKNOWN` (2) is unknown, any
            other value is inside.
        weight: w. An image of weight 0 is not rendered. Its loss and all its gradients are 0, also the gradient with
            respect to the weight, and even if its vertices are not finite.
        kind: "l1" or "smooth_l1".
        blur: as for `silhouette`.
        backend: as for `silhouette`.

    Returns:
        The loss, an area in px².

    Raises:
        ValueError: the shape, type or value of an argument is not as described.
        RuntimeError: backend="native" without kernels.

    Source: Hägerlind et al., "Temporally-consistent 3D Reconstruction of Seabirds" (2024), the term E_msk.
    """
    vertices, faces, target, weight, blur = _loss_operands(vertices_screen, faces, target, weight, kind, blur)
    switch = jax.lax.stop_gradient(weight)
    loss: Any = _mask_loss(vertices, faces, target, switch, kind, blur, _choose(backend))
    return (weight * loss).astype(vertices_screen.dtype)


def mask_loss_and_block(
    vertices_screen: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    target: Bool[Array, "size size"] | UInt8[Array, "size size"],
    weight: Float[Array, ""] | float,
    skin: Skin,
    camera_px: tuple[float, float],
    *,
    kind: Kind = "l1",
    blur: Blur | None = None,
    backend: Backend = "auto",
) -> tuple[Float[Array, ""], Float[Array, "D D"]]:
    """Return `mask_loss`, and the Gauss-Newton block of the soft silhouette for the D parameters of a skinned mesh.

    H = w · Σ j·jᵀ over the known pixels with 0.01 < S < 0.99, where S is `silhouette` and j = dS / d parameters. H is
    the curvature of ½ Σ (S − target)², and the solver uses H for both mask losses. The kernels sum over at most 256
    pixels. Of more pixels they take an evenly spread part, and scale the sum.

    With the edge `unbiased`, j is the derivative of the filtered difference of `mask_loss`, and the sum is over all
    pixels; the kernels take at most 16 · size pixels of the outline.

    One pass of the kernel computes loss, gradient and H. H has no gradient.

    Args:
        vertices_screen, faces, weight, kind, blur, backend: as for `mask_loss`. The depth is that of the camera frame
            of `skin`, in the unit of its rest vertices.
        target: the mask, of bool or uint8, as for `mask_loss`.
        skin: rest vertices, skinning weights and derivatives of the joint transforms.
        camera_px: focal length and centre of the image in pixels of the silhouette, for the pinhole camera
            pixel = focal · (x, y) / z + centre.

    Returns:
        The loss, an area in px², and H, positive semi-definite, px² per unit of each of two parameters.

    Raises:
        ValueError: the shape, type or value of an argument is not as described.
        RuntimeError: backend="native" without kernels.
    """
    vertices, faces, target, weight, blur = _loss_operands(vertices_screen, faces, target, weight, kind, blur)
    if jnp.issubdtype(target.dtype, jnp.floating):
        raise ValueError(f"target: expected bool or uint8, got {target.dtype}")
    switch, skin = jax.lax.stop_gradient((weight, skin))
    settings = tuple(float(x) for x in camera_px), kind, blur, _choose(backend)
    found: Any = _mask_loss_and_block(vertices, faces, target.astype(jnp.uint8), switch, skin, *settings)
    loss, block = found
    return (weight * loss).astype(vertices_screen.dtype), switch * jax.lax.stop_gradient(block)


def _loss_operands(vertices, faces, target, weight, kind, blur):
    """Return checked vertices, faces, target, weight and blur of a loss."""
    _check_mesh(vertices, faces)
    target = _check_target(target)
    if kind not in silhouette_reference.KINDS:
        raise ValueError(f"kind: expected one of {silhouette_reference.KINDS}, got {kind!r}")
    if jnp.shape(weight) != ():
        raise ValueError(f"weight: expected a scalar, got shape {jnp.shape(weight)}")
    blur = Blur.for_size(target.shape[0]) if blur is None else blur
    return *_as_operands(vertices, faces), target, jnp.asarray(weight, jnp.float32), blur


def _check_size(size) -> None:
    if isinstance(size, bool) or not isinstance(size, (int, np.integer)) or not 0 < size <= 2**14:
        raise ValueError(f"size: expected an integer from 1 to {2**14}, got {size!r}")


def _check_target(target) -> Array:
    target = jnp.asarray(target)
    if target.ndim != 2 or target.shape[0] != target.shape[1] or target.shape[0] == 0:
        raise ValueError(f"target: expected shape (size, size), got {target.shape}")
    if jnp.issubdtype(target.dtype, jnp.floating):
        return target.astype(jnp.float32)
    if target.dtype not in (jnp.bool_, jnp.uint8):
        raise ValueError(f"target: expected bool, uint8 or floats, got {target.dtype}")
    return target


def _check_mesh(vertices, faces) -> None:
    if jnp.ndim(vertices) != 2 or jnp.shape(vertices)[1] != 3:
        raise ValueError(f"vertices_screen: expected shape (V, 3), got {jnp.shape(vertices)}")
    if not jnp.issubdtype(jnp.result_type(vertices), jnp.floating):
        raise ValueError(f"vertices_screen: expected floats, got {jnp.result_type(vertices)}")
    if jnp.ndim(faces) != 2 or jnp.shape(faces)[1] != 3:
        raise ValueError(f"faces: expected shape (F, 3), got {jnp.shape(faces)}")
    if not jnp.issubdtype(jnp.result_type(faces), jnp.integer):
        raise ValueError(f"faces: expected integers, got {jnp.result_type(faces)}")


def _as_operands(vertices, faces):
    return jnp.asarray(vertices, jnp.float32), jnp.asarray(faces, jnp.int32)


def _choose(backend: str) -> str:
    if backend not in _BACKENDS:
        raise ValueError(f"backend: expected one of {_BACKENDS}, got {backend!r}")
    if backend == "auto" and not kernels.kernels_available():
        return "reference"
    return backend


def _dispatch(backend: str, native_function, reference_function, *operands):
    """Call one of two functions. For "auto", the program of a platform contains only the function for that platform.

    If the CPU is the default platform of JAX, the program contains the kernels only, because tracing the reference
    takes long. Such a program cannot be compiled for other platforms.
    """
    if backend == "native" or (backend == "auto" and jax.default_backend() == "cpu"):
        return native_function(*operands)
    if backend == "reference":
        return reference_function(*operands)
    return jax.lax.platform_dependent(*operands, cpu=native_function, default=reference_function)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3, 4))
def _silhouette(vertices, faces, size, blur, backend) -> Any:
    return _dispatch(
        backend,
        lambda v, f: kernels.silhouette(v, f, size, blur),
        lambda v, f: silhouette_reference.silhouette(v, f, size, blur),
        vertices,
        faces,
    )


def _silhouette_forward(vertices, faces, size, blur, backend):
    return _silhouette(vertices, faces, size, blur, backend), (vertices, faces)


def _silhouette_backward(size, blur, backend, residuals, cotangent):
    def by_autodiff(v, f, c):
        return jax.vjp(lambda v: silhouette_reference.silhouette(v, f, size, blur), v)[1](c)[0]

    gradient = _dispatch(
        backend, lambda v, f, c: kernels.silhouette_gradient(v, f, c, blur), by_autodiff, *residuals, cotangent
    )
    return gradient, None


_silhouette.defvjp(_silhouette_forward, _silhouette_backward)


@functools.partial(jax.custom_vjp, nondiff_argnums=(4, 5, 6))
def _mask_loss(vertices, faces, target, weight, kind, blur, backend) -> Any:
    return _dispatch(
        backend,
        lambda v, f, t, w: kernels.mask_loss(v, f, t, w, kind, blur),
        lambda v, f, t, w: silhouette_reference.mask_loss(v, f, t, w, kind, blur),
        vertices,
        faces,
        target,
        weight,
    )


def _mask_loss_forward(vertices, faces, target, weight, kind, blur, backend):
    return _dispatch(
        backend,
        lambda v, f, t, w: kernels.mask_loss_and_gradient(v, f, t, w, kind, blur),
        lambda v, f, t, w: jax.value_and_grad(silhouette_reference.mask_loss)(v, f, t, w, kind, blur),
        vertices,
        faces,
        target,
        weight,
    )


def _mask_loss_backward(kind, blur, backend, gradient, cotangent):
    return cotangent * gradient, None, None, None


_mask_loss.defvjp(_mask_loss_forward, _mask_loss_backward)


@functools.partial(jax.custom_vjp, nondiff_argnums=(5, 6, 7, 8))
def _mask_loss_and_block(vertices, faces, target, weight, skin, camera_px, kind, blur, backend) -> Any:
    return _mask_loss_and_block_forward(vertices, faces, target, weight, skin, camera_px, kind, blur, backend)[0]


def _mask_loss_and_block_forward(vertices, faces, target, weight, skin, camera_px, kind, blur, backend):
    @jax.custom_batching.sequential_vmap  # the derivatives of one image need 100 MB, those of a batch all memory
    def reference(v, f, t, w, s):
        loss, gradient = jax.value_and_grad(silhouette_reference.mask_loss)(v, f, t, w, kind, blur)
        return loss, gradient, silhouette_reference.silhouette_gauss_newton(v, f, t, w, s, camera_px, blur)

    loss, gradient, block = _dispatch(
        backend,
        lambda v, f, t, w, s: kernels.mask_loss_gradient_and_block(v, f, t, w, s, camera_px, kind, blur),
        reference,
        vertices,
        faces,
        target,
        weight,
        skin,
    )
    return (loss, block), gradient


def _mask_loss_and_block_backward(camera_px, kind, blur, backend, gradient, cotangents):
    return cotangents[0] * gradient, None, None, None, None


_mask_loss_and_block.defvjp(_mask_loss_and_block_forward, _mask_loss_and_block_backward)
