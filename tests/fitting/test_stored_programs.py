"""Stored traces: what a later process takes from the cache folder, and what it traces again."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.stages import BIRD, CONFIG, FIRST, case, problems, program, row

import jaxfit
from jaxfit.config.fit import InitialiseConfig
from jaxfit.fitting import stored_programs
from jaxfit.fitting.error_bars import _keypoints_and_derivatives
from jaxfit.fitting.initial_poses import _search_tile
from jaxfit.fitting.posterior import curvature_products
from jaxfit.fitting.solve import advance, begin, report
from jaxfit.fitting.stored_programs import StoredProgram
from jaxfit.objective import registry
from jaxfit.objective.residuals import Residuals


@pytest.fixture
def folder(tmp_path):
    """The folder of stored traces, which does not exist yet."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "cache"))
    yield tmp_path / "cache" / "traced"
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.fixture
def traced(monkeypatch):
    """One entry for each trace."""
    traced, export = [], jax.export.export
    monkeypatch.setattr(jax.export, "export", lambda *x, **names: traced.append(x) or export(*x, **names))
    return traced


CASE = case()


def arguments(stage=FIRST, birds=2, config=CONFIG, started=True):
    """Return the arguments of `advance`; with poses in place of the state if not `started`, for keys."""
    start, targets = jax.device_put(row(CASE, slice(birds)))
    own = program(stage, config), problems(start, targets, stage, config)
    return (*own, jnp.int32(3)), begin(*own, None) if started else start


def take_steps(*chosen):
    """Take three steps as a process that has not taken any before."""
    fixed, state = chosen or arguments()
    return StoredProgram(advance.__wrapped__, lambda fixed, state: (state, 0, 0), reuses_state=True)(fixed, state)


def fall(fixed, state):
    """A small function with the form of `advance`."""
    name, (speed, step) = fixed
    return {name: state["height"] + step * speed, "height": state["height"] / 2}


fall.__module__ = "jaxfit.of.this.test"  # functions from outside of the package are not stored


def new_fall():
    """Return the function as a process that has not called it before."""
    return StoredProgram(fall, lambda fixed, state: {fixed[0]: 0, "height": 0})


def fall_once():
    return new_fall()(("place", (jnp.arange(3.0), jnp.float32(2))), {"height": jnp.ones(3)})


def assert_equal(result, expected):
    assert jax.tree.structure(result) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, result, expected)


def test_a_second_process_traces_nothing_and_has_the_same_result(folder, traced):
    results = [take_steps() for _ in range(2)]
    assert len(traced) == len(list(folder.iterdir())) == 1
    assert_equal(*results)
    expected = eqx.filter_jit(advance.__wrapped__)(*arguments())
    assert jax.tree.structure(results[1]) == jax.tree.structure(expected)
    np.testing.assert_allclose(results[1][0].pose.body_pose, expected[0].pose.body_pose, atol=1e-5)
    np.testing.assert_allclose(results[1][1], expected[1], rtol=1e-5)


def test_one_process_reads_and_compiles_a_program_once(folder, traced, monkeypatch):
    program, state = new_fall(), {"height": jnp.ones(3)}
    for height in (1.0, 0.5, 0.25):
        result = program(("place", (jnp.arange(3.0), jnp.float32(2))), state)
        np.testing.assert_allclose(result["place"], height + 2 * np.arange(3.0))
        state = {"height": result["height"]}
        monkeypatch.setattr(stored_programs, "_read", None)
    assert len(traced) == 1


CHANGES = {
    "terms": {"stage": dataclasses.replace(FIRST, terms=("keypoints", "pose_prior", "acceleration"))},
    "solver": {"stage": dataclasses.replace(FIRST, solver="levenberg_marquardt")},
    "silhouette": {"config": dataclasses.replace(CONFIG, crop=dataclasses.replace(CONFIG.crop, size_px=128))},
    "birds": {"birds": 1},
}
"""Arguments with other programs."""


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_another_program_has_another_key(folder, change):
    assert key(**change) != key()
    assert key(**change) == key(**change)


def key(**change):
    arrays, others = eqx.partition(arguments(**change, started=False), eqx.is_array)
    found = stored_programs._key(advance.__wrapped__, arrays, others)
    assert found is not None
    return found


def test_every_large_program_of_a_fit_is_stored(folder):
    (own, several, _), pose = arguments(started=False)
    bird, how = BIRD, InitialiseConfig(method="so3")
    search = (bird, own.rig, several.targets.keypoints_px, several.targets.confidence, None, how, own.camera, True)
    programs = [(_search_tile, search)]
    programs += [(each, (own, several, pose)) for each in (report, curvature_products, _keypoints_and_derivatives)]
    keys = []
    for function, given in programs:
        assert isinstance(function, StoredProgram)
        keys.append(stored_programs._key(function.__wrapped__, *eqx.partition(given, eqx.is_array)))
    other_search = (*search[:5], InitialiseConfig(), *search[6:])
    keys.append(stored_programs._key(_search_tile.__wrapped__, *eqx.partition(other_search, eqx.is_array)))
    assert None not in keys
    assert len(set(keys)) == len(keys)


def test_numbers_do_not_change_the_key(folder):
    stage = dataclasses.replace(FIRST, learning_rate=0.1)
    assert key(stage=stage, config=dataclasses.replace(CONFIG, terms={"velocity": 7})) == key()


def test_sources_versions_and_settings_change_the_key(folder, tmp_path, monkeypatch):
    keys = [key()]
    with jax.default_matmul_precision("float32"):
        keys.append(key())
    for name, value in (("PACKAGE", tmp_path), ("LIBRARIES", ("jax",)), ("ffi_targets", tuple)):
        monkeypatch.setattr(stored_programs, name, value)
        stored_programs._source.cache_clear()
        keys.append(key())
    (tmp_path / "changed.py").write_text("changed = True\n")
    stored_programs._source.cache_clear()
    keys.append(key())
    stored_programs._source.cache_clear()
    assert len(set(keys)) == len(keys)


@pytest.mark.parametrize("damage", [lambda x: x[:100], lambda x: x[:-1] + bytes([x[-1] ^ 1])])
def test_a_damaged_file_is_replaced(folder, traced, damage):
    expected = fall_once()
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    assert_equal(fall_once(), expected)
    assert len(traced) == 2
    assert stored_programs._read(file) is not None


def test_terms_of_users_are_not_stored(folder, traced, monkeypatch):
    def term_of_a_user(window) -> Residuals:
        return Residuals(window.pose.body_pose)

    monkeypatch.setattr(registry, "_terms", dict(registry._terms))
    jaxfit.term(term_of_a_user)
    stage = dataclasses.replace(FIRST, terms=(*FIRST.terms, "term_of_a_user"))
    settings = dataclasses.replace(CONFIG, terms={**CONFIG.terms, "term_of_a_user": 1.0})
    state, *_ = take_steps(*arguments(stage, config=settings))
    assert np.isfinite(state.pose.body_pose).all()
    assert not traced
    assert not folder.exists()


@pytest.mark.parametrize("name", [None, "gs://bucket/cache"])
def test_without_a_local_folder_nothing_is_stored(folder, traced, name):
    expected = fall_once()
    jax.config.update("jax_compilation_cache_dir", name)
    assert_equal(fall_once(), expected)
    assert len(traced) == len(list(folder.iterdir())) == 1


def test_a_folder_that_cannot_be_written_is_no_error(folder, traced):
    folder.parent.mkdir()
    folder.write_text("a file")
    for count in (1, 2):
        assert_equal(fall_once(), fall(("place", (jnp.arange(3.0), jnp.float32(2))), {"height": jnp.ones(3)}))
        assert len(traced) == count
