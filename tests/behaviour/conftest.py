"""Less work for the same results: a test has few poses of two models. Features of a test are its own."""

import pytest

from jaxfit.behaviour import registry
from jaxfit.model.kinematics import fold_bird

BLOCK = 256


@pytest.fixture(autouse=True, scope="package")
def quick_poses():
    """Compute 256 poses at once, so that longer results need several blocks, and fold every model once."""
    rigs = []

    def fold_once(bird):
        for known, rig in rigs:
            if known is bird:
                return rig
        rigs.append((bird, fold_bird(bird)))
        return rigs[-1][1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxfit.behaviour.birds.POSES", BLOCK)
        patch.setattr("jaxfit.behaviour.birds.fold_bird", fold_once, raising=False)
        yield


@pytest.fixture(autouse=True)
def own_registry(monkeypatch):
    """Features that a test registers or imports are removed after the test."""
    registry.own_features()
    for name in ("_features", "_imported"):
        monkeypatch.setattr(registry, name, dict(getattr(registry, name)))
