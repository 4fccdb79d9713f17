"""find_term returns terms by name, entry point or path, and rejects other functions with a reason."""

import importlib
import sys
from importlib import metadata

import equinox as eqx
import jax.numpy as jnp
import pytest
from support.terms_by_hand import posed_window, random_targets, window_pose

import jaxfit
from jaxfit.foundation.errors import InputError
from jaxfit.objective import registry, terms
from jaxfit.objective.objective import evaluate_terms, weighted_sum
from jaxfit.objective.registry import find_term, find_terms, known_terms, term

MODULE = """
import jax.numpy as jnp
from jaxfit.objective.registry import term

def plain(window, *, power=2.0):
    return jnp.sum(jnp.abs(window.pose.body_pose) ** power)

@term(name="marked", positive=["width"], compares_masks=True)
def decorated(window, *, width=1, offset=0.0):
    return jnp.sum(window.targets.mask) / width + offset

number = 3.0
def no_default(window, *, x): return 0.0
def wrong_default(window, *, x=None): return 0.0
def positional(window, x=1.0): return 0.0
def nothing(): return 0.0
def weighs(window, *, weight=1.0): return 0.0
"""


@pytest.fixture(autouse=True)
def own_registry(monkeypatch):
    """Terms that a test registers are removed after the test."""
    monkeypatch.setattr(registry, "_terms", dict(registry._terms))


@pytest.fixture
def package(tmp_path, monkeypatch):
    (tmp_path / "own_priors.py").write_text(MODULE)
    (tmp_path / "broken_priors.py").write_text("raise RuntimeError('no luck')")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    sys.modules.pop("own_priors", None)


def test_a_term_of_this_session():
    assert jaxfit.term is term

    @jaxfit.term
    def stillness(window, *, beta=2):
        return beta * jnp.sum(window.pose.body_pose**2)

    found = find_term("stillness")
    assert found.function is stillness
    assert (found.settings, found.positive, found.compares_masks) == ({"beta": 2.0}, frozenset(), False)
    assert "stillness" in known_terms()
    pose = window_pose()
    settings = {"stillness": {"weight": 3.0, "beta": 0.5}}
    expected = 1.5 * float(jnp.sum(pose.body_pose**2))
    total = weighted_sum(posed_window(pose, random_targets()), find_terms(settings), settings)
    assert float(total) == pytest.approx(expected, rel=1e-5)


def test_a_term_that_is_registered_again_is_compiled_again_and_nothing_else_is():
    traces = []

    @eqx.filter_jit
    def total(pose, terms):
        traces.append(None)
        return weighted_sum(posed_window(pose, random_targets()), terms, {name: {"weight": 1.0} for name in terms})

    pose = window_pose()
    total(pose, find_terms(["pose_prior"]))
    for value in (1.0, 2.0):

        @term(name="again")
        def own(window):
            return jnp.float32(value)  # noqa: B023

        assert float(total(pose, find_terms(["again"]))) == value
    total(pose, find_terms(["pose_prior"]))
    assert len(traces) == 3  # pose_prior once, `again` twice


def test_another_module_cannot_use_the_name_of_a_term():
    def velocity(window):
        return 0.0

    for taken in ("velocity", "keypoints"):
        with pytest.raises(InputError, match=rf"'{taken}'.*jaxfit\.objective\."):
            term(name=taken)(velocity)
    assert find_term("keypoints").function is terms.keypoints
    importlib.reload(importlib.import_module("jaxfit.objective.temporal"))  # a module may register its own again


def test_by_path(package):
    found = find_term("own_priors:plain")
    assert found.settings == {"power": 2.0}
    assert not found.compares_masks
    marked = find_term("own_priors:decorated")
    assert marked.compares_masks
    assert marked.positive == {"width"}
    assert find_term("marked").function is marked.function
    assert "own_priors:plain" not in known_terms()
    assert "marked" in known_terms()
    pose = window_pose()
    settings = {"own_priors:plain": {"weight": 1.0, "power": 1.0}}
    value = evaluate_terms(posed_window(pose, random_targets()), find_terms(settings), settings)
    assert float(value["own_priors:plain"]) == pytest.approx(float(jnp.abs(pose.body_pose).sum()), rel=1e-5)


def test_a_reloaded_module_replaces_its_terms(package):
    assert find_term("own_priors:plain").settings == {"power": 2.0}
    (package / "own_priors.py").write_text("def plain(window, *, changed=7.25):\n    return 0.0\n")
    importlib.invalidate_caches()
    importlib.reload(sys.modules["own_priors"])
    assert find_term("own_priors:plain").settings == {"changed": 7.25}


def test_by_entry_point(package, monkeypatch):
    offered = metadata.EntryPoint("cosy", "own_priors:plain", registry.ENTRY_POINTS)
    clash = metadata.EntryPoint("velocity", "own_priors:plain", registry.ENTRY_POINTS)

    def entry_points(*, group):
        return metadata.EntryPoints([offered, clash] if group == "jaxfit.terms" else [])

    monkeypatch.setattr(metadata, "entry_points", entry_points)
    assert "cosy" in known_terms()
    assert find_term("cosy").settings == {"power": 2.0}
    assert find_term("velocity").function.__module__ == "jaxfit.objective.temporal"  # jaxfit's own term has priority
    assert known_terms().count("velocity") == 1


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("absent_priors:plain", ("cannot be imported", "absent_priors", "PYTHONPATH")),
        ("broken_priors:plain", ("cannot be imported", "RuntimeError: no luck")),
        ("own_priors:absent", ("has no function 'absent'",)),
        ("own_priors:number", ("is not a function", "float")),
        ("own_priors:no_default", ("'x'", "default of the setting is not a finite number")),
        ("own_priors:wrong_default", ("'x'", "default of the setting is not a finite number")),
        ("own_priors:positional", ("'x', which is not keyword-only",)),
        ("own_priors:nothing", ("does not take the window",)),
        ("own_priors:weighs", ("'weight'",)),
        ("builtins:max", ("does not take the window",)),
    ],
)
def test_objects_that_are_not_terms_are_rejected(package, path, words):
    with pytest.raises(InputError) as caught:
        find_term(path)
    for word in (repr(path) if path.isprintable() and len(path) < 50 else "term", *words):
        assert word in str(caught.value)


def test_unknown_names():
    with pytest.raises(KeyError):
        find_term("unknown")
    with pytest.raises(InputError, match=r"'width'.*positive"):
        term(positive=["width"])(lambda window: 0.0)


@pytest.mark.parametrize(
    ("returned", "said"),
    [
        (lambda: jnp.ones(3), r"float32 of shape \(3,\)"),
        (lambda: jnp.ones(()) > 0, r"bool of shape \(\)"),
        (lambda: jnp.int32(3), "int32"),
        (lambda: None, "NoneType"),
        (lambda: (jnp.ones(()), jnp.ones(())), r"of shape \(2,\)|tuple"),
    ],
)
def test_a_term_is_one_real_number(returned, said):
    term(name="odd")(lambda window: returned())
    with pytest.raises(InputError, match=rf"term 'odd': returned .*{said}"):
        evaluate_terms(posed_window(window_pose(), random_targets()), find_terms(["odd"]), {"odd": {"weight": 1.0}})
