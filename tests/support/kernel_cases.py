"""The stored cases of the kernels: meshes, masks, and what the reference implementations compute for them.

`python tests/support/kernel_cases.py` writes tests/raster/kernel_cases.txt again.
tests/raster/kernel_cases.cc reads this file.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from jaxfit.raster import silhouette_reference as reference
from jaxfit.raster.zbuffer_reference import fragments

STORED = Path(__file__).resolve().parents[1] / "raster" / "kernel_cases.txt"
PARAMETERS, SHAPES, JOINTS, PER_VERTEX = 16, 16, 3, 2
FOCAL_PX, CENTRE_PX = 90.0, 15.0


def _bumpy(seed: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a closed mesh of 80 faces, whose outline has bumps and whose faces lie over one another."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    rng = np.random.default_rng(seed)
    points = np.asarray(ball.vertices) * rng.uniform(0.5, 1.3, (len(ball.vertices), 1))
    screen = points * [0.3 * size, 0.22 * size, 0.5] + [0.52 * size, 0.47 * size, 4]
    return screen.round(3).astype(np.float32), np.asarray(ball.faces, np.int32)


def _sheet(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return an open mesh that leaves the image, with a large face, a flat face and faces behind the camera."""
    corners = np.array(
        [[-9, 3, 2], [0.9, 0.2, 2], [0.7, 0.8, 3], [0.1, 0.6, 2.5], [0.5, 0.5, -1], [0.3, 0.9, 2], [0.6, 0.2, 3]]
    )
    faces = np.array([[0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 5, 6], [1, 1, 2], [6, 5, 0]], np.int32)
    return (corners * [size, size, 1]).astype(np.float32), faces


def cases() -> list[dict[str, np.ndarray]]:
    """Return the arrays of every case by name."""
    soft, sharp, unbiased = reference.Blur(0.4, 1.9), reference.Blur(0.2, 1.3), reference.Blur(0.6, 1.8, "unbiased")
    return [
        _case(_bumpy(0, 30), 30, soft, 1),
        _case(_bumpy(1, 33), 33, sharp, 2),
        _case(_sheet(24), 24, soft, 3),
        _case(_bumpy(2, 30), 30, unbiased, 4),
        _case(_sheet(21), 21, unbiased, 5),
    ]


def _case(mesh, size: int, blur: reference.Blur, seed: int) -> dict[str, np.ndarray]:
    vertices, faces = (jnp.asarray(part) for part in mesh)
    rng = np.random.default_rng(seed)
    target = np.zeros((size, size), np.uint8)
    target[size // 4 : 3 * size // 4, size // 3 : 4 * size // 5] = 1
    target[: size // 5, size // 2 :] = 2
    cotangent = rng.normal(size=(size, size)).round(1).astype(np.float32)
    skin = reference.Skin(
        jnp.asarray(rng.normal(size=vertices.shape).round(1), jnp.float32),
        jnp.asarray(rng.integers(0, JOINTS, (len(vertices), PER_VERTEX)), jnp.int32),
        jnp.asarray(rng.dirichlet(np.ones(PER_VERTEX), len(vertices)).round(2), jnp.float32),
        jnp.asarray(rng.normal(size=(JOINTS, 3, 4)).round(1), jnp.float32),
        jnp.asarray(rng.normal(scale=0.1, size=(3, 4, PARAMETERS)).round(2), jnp.float32),
        jnp.asarray(rng.integers(0, 2, (JOINTS, PARAMETERS)), jnp.float32),
        jnp.asarray(rng.normal(size=(3, 3)).round(1), jnp.float32),
        jnp.asarray(rng.normal(scale=0.1, size=(len(vertices), 3, SHAPES)).round(2), jnp.float32),
    )
    one = jnp.float32(1)
    arrays = {
        "size": size,
        "sigma": blur.sigma,
        "radius": blur.radius,
        "edge": reference.EDGES.index(blur.edge),
        "vertices": vertices,
        "faces": faces,
        "target": target,
        "cotangent": cotangent,
        "rest": skin.rest,
        "joint": skin.joint,
        "skin_weight": skin.weight,
        "transforms": skin.transforms,
        "generators": skin.generators,
        "moved": skin.moved,
        "view": skin.view,
        "shape": skin.shape_basis,
        "transforming": PARAMETERS,
        "parameters": PARAMETERS + SHAPES,
        "focal": FOCAL_PX,
        "centre": CENTRE_PX,
    }
    image, pull_back = jax.vjp(lambda v: reference.silhouette(v, faces, size, blur), vertices)
    arrays |= {"silhouette": image, "pull": pull_back(jnp.asarray(cotangent))[0]}
    for kind in reference.KINDS:
        loss = jax.value_and_grad(reference.mask_loss)(vertices, faces, jnp.asarray(target), one, kind, blur)
        arrays |= {kind: loss[0], f"{kind}_gradient": loss[1]}
    arrays["block"] = reference.silhouette_gauss_newton(
        vertices, faces, jnp.asarray(target), one, skin, (FOCAL_PX, CENTRE_PX), blur
    )
    face, _, depth = fragments(np.asarray(vertices), np.asarray(faces), size, size)
    arrays |= {"face": face, "depth": np.where(np.isfinite(depth), depth, 0)}
    return {name: np.asarray(array, np.float64).ravel() for name, array in arrays.items()}


def text_of(stored: list[dict[str, np.ndarray]]) -> str:
    """Return the text of a file of cases: a name, a count and the numbers of each array on a line."""
    lines = []
    for number, arrays in enumerate(stored):
        lines.append(f"case {number}")
        for name, values in arrays.items():
            lines.append(f"{name} {values.size} " + " ".join(f"{np.float32(value):.7g}" for value in values))
    return "\n".join(lines) + "\n"


def read_cases(text: str) -> list[dict[str, np.ndarray]]:
    """Return the arrays of a file of cases."""
    stored: list[dict[str, np.ndarray]] = []
    for line in text.splitlines():
        name, _, *numbers = line.split()
        if name == "case":
            stored.append({})
        else:
            stored[-1][name] = np.array(numbers, np.float64)
    return stored


if __name__ == "__main__":
    STORED.write_text(text_of(cases()), encoding="utf-8")
