"""Features of notebooks and other packages: their names, the messages about wrong features, their values."""

import importlib
import sys
from importlib import metadata

import numpy as np
import pytest
from support.described import flock, pair, renamed, result

import jaxfit.behaviour.describe as describing
from jaxfit.behaviour import registry
from jaxfit.behaviour.describe import describe
from jaxfit.behaviour.motion import speed
from jaxfit.behaviour.registry import feature, find_feature, own_features
from jaxfit.foundation.errors import InputError

OWN = own_features()


MODULE = """
import numpy as np
from jaxfit.behaviour.registry import feature

def plain(birds):
    return birds.place[..., 2]

@feature(unit="deg", name="marked", keypoints=["left_eye"], circular=True)
def decorated(birds):
    return np.zeros(birds.valid.shape)

def body_pitch(birds): return np.zeros(birds.valid.shape)
number = 3.0
def nothing(): return 0.0
def two(birds, more): return 0.0
def optional(birds, more=2.0): return np.full(birds.valid.shape, more)
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    (tmp_path / "own_birds.py").write_text(MODULE)
    (tmp_path / "broken_birds.py").write_text("raise RuntimeError('no luck')")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    sys.modules.pop("own_birds", None)


def test_a_feature_of_this_session():
    @feature(unit="length", keypoints=("bill_tip",), needs=("level",))
    def bill_height(birds):
        """Height of
        the bill."""
        return birds.keypoint("bill_tip")[..., 2]

    found = find_feature("bill_height")
    assert found.function is bill_height
    assert found.definition == "Height of the bill."
    assert bill_height not in [each.function for each in own_features()]
    described = describe(flock(pair(6)), [found])
    assert described.column("bill_height") == "bill_height_m"
    assert described.features[-1] is found
    assert (described.values["bill_height"] > 0.2).all()
    bird = renamed(bill_tip="beak")
    without = describe(flock(result(bird=bird), bird=bird), [found])
    assert without.missing["bill_height"] == "the model has no keypoint bill_tip"


def test_a_cell_may_run_again_and_other_modules_may_not_take_a_name(package):
    for value in (1.0, 2.0):

        @feature
        def twice(birds):
            return np.full(birds.valid.shape, value)  # noqa: B023

        assert (describe(flock(pair()), [find_feature("twice")]).values["twice"] == value).all()
    with pytest.raises(InputError, match=r"'speed': is already the name of a feature of jaxfit\.behaviour\.motion"):
        feature(name="speed")(twice)
    importlib.reload(importlib.import_module("jaxfit.behaviour.motion"))  # a module may register its own again
    assert len(own_features()) == len(OWN)


def test_by_path_and_by_entry_point(package, monkeypatch):
    plain = find_feature("own_birds:plain")
    assert (plain.name, plain.unit, plain.needs) == ("plain", "1", ())
    marked = find_feature("own_birds:decorated")
    assert (marked.name, marked.unit, marked.circular) == ("marked", "deg", True)
    assert find_feature("marked") is marked
    found = describe(flock(pair()), [plain, marked, find_feature("own_birds:optional")])
    np.testing.assert_allclose(found.values["plain"], 0.2, atol=1e-6)
    assert (found.values["optional"] == 2).all()
    assert (found.column("plain"), found.column("marked")) == ("plain", "marked_deg")
    point = metadata.EntryPoint("cosy", "own_birds:plain", registry.ENTRY_POINTS)

    def entry_points(*, group):
        return metadata.EntryPoints([point] if group == "jaxfit.features" else [])

    monkeypatch.setattr(metadata, "entry_points", entry_points)
    assert (find_feature("cosy").name, find_feature("cosy").function) == ("cosy", plain.function)


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("absent_birds:plain", ("cannot be imported", "PYTHONPATH")),
        ("broken_birds:plain", ("cannot be imported", "RuntimeError: no luck")),
        ("own_birds:absent", ("has no function 'absent'",)),
        ("own_birds:number", ("is not a function", "float")),
        ("own_birds:nothing", ("does not take the birds",)),
        ("own_birds:two", ("does not take the birds",)),
        ("body_ptich", ("body_pitch",)),
        ("tallness", ("is not known", "package.module:function", "airborne")),
    ],
)
def test_objects_that_are_not_features_are_rejected(package, path, words):
    with pytest.raises(InputError) as caught:
        find_feature(path)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"unit": "rad"}, "has the unit 'rad'"),
        ({"needs": ("legs",)}, "needs 'legs'"),
        ({"needs": "time"}, r"needs=\('time',\)"),
        ({"name": "two words"}, "is not a name"),
        ({"keypoints": "bill_tip"}, r"keypoints=\('bill_tip',\)"),
    ],
)
def test_wrong_options_of_the_decorator(options, message):
    def seen(birds):
        return birds.valid

    with pytest.raises(InputError, match=message):
        feature(**options)(seen)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda birds: 1 / 0, "'wrong': raised ZeroDivisionError: division by zero"),
        (lambda birds: birds.keypoint("tooth"), "raised ValueError"),
        (lambda birds: birds.place, "returned an array of 2 × 4 × 3"),
        (lambda birds: 1.0, "returned an array of no axis"),
        (lambda birds: birds.valid[:, :1], "returned an array of 2 × 1"),
        (lambda birds: "text", "returned values of the type <U4, not numbers"),
        (lambda birds: None, "returned values of the type object"),
        (lambda birds: 1j * birds.place[..., 0], "returned values of the type complex128"),
        (lambda birds: sys.exit("no more"), "raised SystemExit: no more"),
    ],
)
def test_a_feature_that_fails_is_named(function, message):
    feature(name="wrong")(function)
    with pytest.raises(InputError, match=message):
        describe(flock(pair()), [find_feature("wrong")])


def test_infinite_values_are_not_defined():
    feature(name="endless")(lambda birds: np.where(birds.track_id[:, None] == 1, np.inf, 1.0) + 0 * birds.place[..., 0])
    found = describe(flock(pair()), [find_feature("endless")]).values["endless"]
    assert np.isnan(found[0]).all()
    assert (found[1] == 1).all()


def test_a_path_cannot_replace_an_own_feature(package):
    with pytest.raises(InputError, match="body_pitch"):
        describe(flock(pair()), [find_feature("own_birds:body_pitch")])


def test_features_do_not_share_what_they_change():
    """A feature that is computed once is used by others; the values in tables stay those of its own function."""
    calls = []

    @feature
    def counted(birds):
        calls.append(None)
        return birds.place[..., 0]

    @feature
    def uses(birds):
        return 2 * birds.once(counted)

    found = describe(flock(pair()), [find_feature("uses"), find_feature("counted")])
    np.testing.assert_allclose(found.values["uses"], 2 * found.values["counted"])
    assert len(calls) == 1


@pytest.mark.parametrize(
    "of", [lambda birds: birds.joints, lambda birds: birds.track_id, lambda birds: birds.once(speed)]
)
def test_a_feature_cannot_change_what_others_receive(of):
    @feature(needs=("time", "level"))
    def careless(birds):
        of(birds)[:] = 0
        return birds.place[..., 0]

    with pytest.raises(InputError, match="feature 'careless': raised ValueError: assignment destination is read-only"):
        describe(flock(pair()), [find_feature("careless")])


def test_a_feature_sees_a_part_of_the_film(monkeypatch):
    """Blocks of 20 frames, and the frames of 2 s on both sides."""
    seen = []

    @feature(needs=("time",))
    def counted(birds):
        seen.append(birds.valid.shape[1])
        return birds.place[..., 0]

    monkeypatch.setattr(describing, "CHUNK", 20)
    describe(flock(pair(60), fps=5), [find_feature("counted")], own=[])
    assert seen == [30, 40, 30]
