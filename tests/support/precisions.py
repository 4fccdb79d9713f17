"""Matrices of windows as blocks and as dense matrices."""

import numpy as np

from jaxfit.fitting.posterior import Blocks


def dense(H):
    """Return the whole matrix of some blocks: frames, then shared parameters."""
    _, frames, L, _ = H.band.shape
    C = len(H.corner)
    full = np.zeros((frames * L + C, frames * L + C))
    for k in range(3):
        for t in range(frames - k):
            at, later = slice(t * L, (t + 1) * L), slice((t + k) * L, (t + k + 1) * L)
            full[at, later] = H.band[k, t]
            full[later, at] = H.band[k, t].T
    full[: frames * L, frames * L :] = H.border.reshape(frames * L, C)
    full[frames * L :, : frames * L] = full[: frames * L, frames * L :].T
    full[frames * L :, frames * L :] = H.corner
    return full


def blocks(full, frames, L):
    """Return the blocks of a whole matrix inside the band."""
    C, inside = len(full) - frames * L, full[: frames * L, : frames * L].reshape(frames, L, frames, L)
    band = np.zeros((3, frames, L, L))
    for k in range(3):
        for t in range(frames - k):
            band[k, t] = inside[t, :, t + k]
    return Blocks(band, full[: frames * L, frames * L :].reshape(frames, L, C), full[frames * L :, frames * L :])


def random_precision(frames, L, C, seed=0):
    """Return blocks of a positive definite matrix: the sum over runs of three frames of GᵀG."""
    rng, n = np.random.default_rng(seed), frames * L + C
    full = 0.1 * np.eye(n)
    for t in range(frames):
        columns = [*range(t * L, min(t + 3, frames) * L), *range(frames * L, n)]
        G = np.zeros((L + 1, n))
        G[:, columns] = rng.normal(size=(L + 1, len(columns)))
        full += G.T @ G
    return blocks(full, frames, L)
