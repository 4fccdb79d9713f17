"""The compiled functions check their arguments, without the help of the Python functions that usually call them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfit.raster import kernels as native

pytestmark = pytest.mark.skipif(not native.kernels_available(), reason="built without the kernels")

B, V, C, H, W, R = 2, 3, 4, 5, 6, 7
FITTING_GRADIENT = r"gradient: expected shape \(2, 3, 3\), got "
RENDERER = {
    "zbuffer": {"face": (B, H, W), "barycentric": (B, H, W, 3), "depth": (B, H, W)},
    "hard_mask": {"mask": (B, H, W)},
    "mask_overlap": {
        "sizes": np.full((B, 2), W, np.int32),
        "runs": (R, 2),
        "run_ends": np.array([3, R]),
        "box": (B, 4),
        "area": (B,),
        "shared": (R,),
    },
    "interpolate": {
        "attributes": (B, V, C),
        "samples": 2,
        "values": (B, H, W, C),
        "coverage": (B, H, W),
        "face": (B, H, W),
    },
    "draw": {"colours": (V, 3), "samples": 2, "image": (H, W, 3)},
}
TYPES = dict.fromkeys(["faces", "face", "runs", "box", "area", "shared"], np.int32) | {"mask": bool, "image": np.uint8}


def call_renderer(function, **changed):
    """Calls a function of the renderer with arrays of zeros and the given values; some have another shape or value."""
    batch = 1 if function == "draw" else B
    shapes = {"vertices": (batch, V, 3), "faces": (1, 3)} | RENDERER[function] | changed
    arguments = {
        name: np.zeros(shape, TYPES.get(name, np.float32)) if isinstance(shape, tuple) else shape
        for name, shape in shapes.items()
    }
    getattr(native.require_kernels(), function)(**arguments)


def test_the_renderer_accepts_shapes_that_fit():
    for function in RENDERER:
        call_renderer(function)


@pytest.mark.parametrize(
    ("function", "changed", "message"),
    [
        ("interpolate", {"samples": 9}, "samples: expected 1 to 8, got 9"),
        ("interpolate", {"samples": 0}, "samples: expected 1 to 8, got 0"),
        ("draw", {"samples": 9}, "samples: expected 1 to 8, got 9"),
        ("draw", {"samples": -1}, "samples: expected 1 to 8, got -1"),
        ("zbuffer", {"face": (B, H, 0)}, "width: expected 1 to 16384, got 0"),
        ("hard_mask", {"mask": (B, 16385, 1)}, "height: expected 1 to 16384, got 16385"),
        ("zbuffer", {"face": (1, H, W)}, r"face: expected shape \(2, 5, 6\), got \(1, 5, 6\)"),
        ("zbuffer", {"barycentric": (B, H, 2, 3)}, r"barycentric: expected shape \(2, 5, 6, 3\), got \(2, 5, 2, 3\)"),
        ("zbuffer", {"depth": (B, 1, W)}, r"depth: expected shape \(2, 5, 6\), got \(2, 1, 6\)"),
        ("hard_mask", {"mask": (1, H, W)}, r"mask: expected shape \(2, 5, 6\), got \(1, 5, 6\)"),
        ("hard_mask", {"vertices": (B, 0, 3)}, r"faces: an index is not in \[0, 0\)"),
        ("mask_overlap", {"sizes": np.ones((1, 2), np.int32)}, r"sizes: expected shape \(2, 2\), got \(1, 2\)"),
        ("mask_overlap", {"sizes": np.array([[1, 1], [0, 1]], np.int32)}, "width: expected 1 to 16384, got 0"),
        ("mask_overlap", {"sizes": np.array([[1, 16385]] * 2, np.int32)}, "height: expected 1 to 16384, got 16385"),
        ("mask_overlap", {"run_ends": np.array([R])}, r"run_ends: expected shape \(2\), got \(1\)"),
        ("mask_overlap", {"run_ends": np.array([2, 1])}, "run_ends: expected increasing numbers up to 7"),
        ("mask_overlap", {"run_ends": np.array([-1, 1])}, "run_ends: expected increasing numbers"),
        ("mask_overlap", {"run_ends": np.array([R, R + 1])}, "run_ends: expected increasing numbers"),
        ("mask_overlap", {"box": (1, 4)}, r"box: expected shape \(2, 4\), got \(1, 4\)"),
        ("mask_overlap", {"area": (1,)}, r"area: expected shape \(2\), got \(1\)"),
        ("mask_overlap", {"shared": (1,)}, r"shared: expected shape \(7\), got \(1\)"),
        ("mask_overlap", {"vertices": (B, 0, 3)}, r"faces: an index is not in \[0, 0\)"),
        ("interpolate", {"attributes": (B, 1, C)}, r"attributes: expected shape \(2, 3, 4\), got \(2, 1, 4\)"),
        ("interpolate", {"values": (B, H, W, 1)}, r"values: expected shape \(2, 5, 6, 4\), got \(2, 5, 6, 1\)"),
        ("interpolate", {"coverage": (B, H, 1)}, r"coverage: expected shape \(2, 5, 6\), got \(2, 5, 1\)"),
        ("interpolate", {"face": (1, H, W)}, "expected shape"),
        ("draw", {"colours": (1, 3)}, r"colours: expected shape \(3, 3\), got \(1, 3\)"),
        ("draw", {"vertices": (B, V, 3)}, r"vertices: expected shape \(1, 3, 3\), got \(2, 3, 3\)"),
    ],
)
def test_the_renderer_rejects_shapes_that_do_not_fit(function, changed, message):
    with pytest.raises(ValueError, match=message):
        call_renderer(function, **changed)


TRANSFORMS = ("transforms", "generators", "moved")
HANDLERS = {
    "jaxfit_silhouette": (("vertices", "faces"), ("image",)),
    "jaxfit_silhouette_gradient": (("vertices", "faces", "cotangent"), ("gradient",)),
    "jaxfit_mask_loss": (("vertices", "faces", "target", "weight"), ("loss",)),
    "jaxfit_mask_loss_and_gradient": (("vertices", "faces", "target", "weight"), ("loss", "gradient")),
    "jaxfit_mask_loss_gradient_and_block": (
        ("vertices", "faces", "mask", "weight", "rest", "joint", "skin_weight", *TRANSFORMS, "view", "shape"),
        ("loss", "gradient", "block"),
    ),
}
OPERAND_TYPES = {"faces": jnp.int32, "joint": jnp.int32, "mask": jnp.uint8}
SHAPES = {
    "vertices": (B, V, 3),
    "faces": (1, 1, 3),
    "cotangent": (B, H, H),
    "target": (1, H, H),
    "weight": (B,),
    "image": (B, H, H),
    "gradient": (B, V, 3),
    "loss": (B,),
    "mask": (1, H, H),
    "rest": (1, V, 3),
    "joint": (1, V, 2),
    "skin_weight": (1, V, 2),
    "transforms": (B, 2, 3, 4),
    "generators": (B, 3, 4, 16),
    "moved": (1, 2, 16),
    "view": (B, 3, 3),
    "shape": (1, V, 3, 0),
    "block": (B, 16, 16),
}


def call_handler(handler, **changed):
    """Calls one of XLA's handlers with arrays of zeros, of which some have another shape."""
    attributes = {"sigma": 1.0, "radius": 2.0, "edge": 0} | ({"kind": 0} if "loss" in handler else {})
    attributes |= {"focal": 9.0, "centre": 3.0} if "block" in handler else {}
    attributes |= {name: changed.pop(name) for name in list(changed) if name in attributes}
    shapes = SHAPES | changed
    operands, results = HANDLERS[handler]
    types = [jax.ShapeDtypeStruct(shapes[name], jnp.float32) for name in results]
    call = jax.ffi.ffi_call(handler, types if len(types) > 1 else types[0])
    arrays = [jnp.zeros(shapes[name], OPERAND_TYPES.get(name, jnp.float32)) for name in operands]
    settings = {name: np.int32(v) if name in ("kind", "edge") else np.float32(v) for name, v in attributes.items()}
    return jax.block_until_ready(call(*arrays, **settings))


def test_the_handlers_accept_shapes_that_fit():
    for handler in HANDLERS:
        for edge in (0, 1):
            call_handler(handler, edge=edge)


@pytest.mark.parametrize(
    ("handler", "changed", "message"),
    [
        ("jaxfit_silhouette", {"image": (B, H, W)}, r"image: expected shape \(2, 6, 6\), got \(2, 5, 6\)"),
        ("jaxfit_silhouette", {"image": (3,)}, r"image: expected shape \(3, 3\), got \(3\)"),
        ("jaxfit_silhouette", {"vertices": (3, V, 3)}, r"vertices: expected .* \(2\) .* got \(3, 3, 3\)"),
        ("jaxfit_silhouette", {"faces": (1, 1, 4)}, r"faces: expected .* followed by \(any, 3\), got \(1, 1, 4\)"),
        ("jaxfit_silhouette", {"sigma": 0}, "blur: expected a positive sigma"),
        ("jaxfit_silhouette", {"edge": 2}, "edge: expected 0 or 1, got 2"),
        ("jaxfit_silhouette_gradient", {"gradient": (B, 1, 3)}, FITTING_GRADIENT + r"\(2, 1, 3\)"),
        ("jaxfit_silhouette_gradient", {"gradient": (B, V, 1)}, FITTING_GRADIENT + r"\(2, 3, 1\)"),
        ("jaxfit_silhouette_gradient", {"cotangent": (B, 0, 0)}, "cotangent: expected a square image"),
        ("jaxfit_silhouette_gradient", {"cotangent": (B, H, W)}, r"cotangent: .* \(6, 6\), got \(2, 5, 6\)"),
        ("jaxfit_mask_loss", {"target": (1, 0, 0)}, "target: expected a square image"),
        ("jaxfit_mask_loss", {"weight": (3,)}, r"weight: expected the batch dimensions \(2\)"),
        ("jaxfit_mask_loss", {"kind": 2}, "kind: expected 0 or 1, got 2"),
        ("jaxfit_mask_loss_and_gradient", {"gradient": (B, 1, 3)}, FITTING_GRADIENT + r"\(2, 1, 3\)"),
        ("jaxfit_mask_loss_and_gradient", {"gradient": (1, V, 3)}, FITTING_GRADIENT + r"\(1, 3, 3\)"),
        ("jaxfit_mask_loss_and_gradient", {"kind": -1}, "kind: expected 0 or 1, got -1"),
        ("jaxfit_mask_loss_gradient_and_block", {"block": (B, 16, 32)}, r"block: .*\(2, 32, 32\), got \(2, 16, 32\)"),
        ("jaxfit_mask_loss_gradient_and_block", {"block": (B, 8, 8)}, "block: expected a multiple of 16 parameters"),
        ("jaxfit_mask_loss_gradient_and_block", {"rest": (B, 1, 3)}, r"rest: .*\(3, 3\), got \(2, 1, 3\)"),
        ("jaxfit_mask_loss_gradient_and_block", {"moved": (B, 1, 16)}, r"moved: .*\(2, 16\), got \(2, 1, 16\)"),
        ("jaxfit_mask_loss_gradient_and_block", {"joint": (1, V, 9)}, "joint: expected at most 8 joints per vertex"),
        ("jaxfit_mask_loss_gradient_and_block", {"transforms": (B, 0, 3, 4)}, r"joint: an index is not in \[0, 0\)"),
    ],
)
def test_the_handlers_reject_shapes_that_do_not_fit(handler, changed, message):
    with pytest.raises(Exception, match=message):
        call_handler(handler, **changed)
