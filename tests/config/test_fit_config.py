"""Configs of fits: shipped configs, bases, and errors that name the key and the file."""

import dataclasses

import pytest
import yaml

from jaxfit.config.fit import FitConfig, StageConfig, load_config, shipped_fit_configs
from jaxfit.config.yaml_file import _parse, config_to_yaml
from jaxfit.foundation.errors import InputError
from jaxfit.objective.registry import find_term, known_terms


def written(tmp_path, text, name="mine.yaml"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_the_shipped_configs():
    assert {"paper", "baseline", "aves"} <= set(shipped_fit_configs())
    paper, baseline = load_config("paper"), load_config("baseline")
    assert (paper.window, paper.common_size, paper.filter_window) == (100, True, 5)
    assert [(s.steps, s.learning_rate) for s in paper.stages] == [(600, 0.01), (400, 0.01)]
    assert [("mask" in s.terms) for s in paper.stages] == [False, True]
    assert all(s.step_scale["transl"][2] == 0 for s in paper.stages)  # depth is fixed
    settings = paper.stage_settings(paper.stages[1])
    assert {name: values["weight"] for name, values in settings.items()} == {
        "keypoints": 1,
        "mask": 1,
        "pose_prior": 100,
        "velocity": 100,
        "acceleration": 100,
    }
    assert settings["keypoints"]["sigma_px"] == 50
    assert (settings["velocity"]["beta_global"], settings["velocity"]["beta_pose"]) == (10, 1)
    # the single-frame baseline differs only in these values
    assert dataclasses.replace(baseline, window=100, common_size=True, filter_window=5) == paper
    assert (baseline.window, baseline.common_size, baseline.filter_window) == (1, False, 1)


@pytest.mark.parametrize("name", shipped_fit_configs())
def test_round_trip(tmp_path, name):
    config = load_config(name)
    path = written(tmp_path, config_to_yaml(config))
    assert load_config(path) == config
    assert load_config(str(path)) == config


def without_one_key(value):
    """Yield copies of nested mappings and lists that lack one key each."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield {other: kept for other, kept in value.items() if other != key}
            yield from ({**value, key: changed} for changed in without_one_key(inner))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from ([*value[:i], changed, *value[i + 1 :]] for changed in without_one_key(inner))


@pytest.mark.parametrize("name", shipped_fit_configs())
def test_shipped_files_hold_only_overrides(tmp_path, name):
    """Every key of a shipped file changes a default or a value of the base."""
    for reduced in without_one_key(_parse(name).values):
        path = written(tmp_path, yaml.safe_dump(reduced))
        try:
            same = load_config(path) == load_config(name)
        except InputError:  # the key is required
            same = False
        assert not same, reduced


def test_a_file_overrides_its_base_key_by_key(tmp_path):
    written(tmp_path, "base: paper\nwindow: 20\nterms: {velocity: 7}\n", "below.yaml")
    path = written(tmp_path, "base: below.yaml\ncrop: {padding: 1}\nterms: {keypoints: {sigma_px: 9}}\n")
    config, paper = load_config(path), load_config("paper")
    assert (config.window, config.filter_window) == (20, paper.filter_window)
    assert config.crop == dataclasses.replace(paper.crop, padding=1.0)
    assert isinstance(config.crop.padding, float)
    assert config.terms["velocity"] == 7
    assert config.terms["keypoints"] == {"weight": 1, "sigma_px": 9}  # also below the first level
    assert config.terms["acceleration"] == 100
    assert config.stages == paper.stages


def test_a_file_beside_wins_over_a_shipped_name(tmp_path):
    written(tmp_path, "base: baseline\nwindow: 3\n", "own.yaml")
    assert load_config(written(tmp_path, "base: own.yaml\n")).window == 3
    assert load_config(written(tmp_path, "base: baseline\n")).window == 1


def test_balanced_overrides_weights_and_the_edge_of_fast():
    fast, balanced = load_config("fast"), load_config("balanced")
    assert (balanced.unknown_pixels, balanced.edge) == (True, "unbiased")
    assert (fast.unknown_pixels, fast.edge) == (False, "soft_rasterizer")  # the paper's objective
    stage = balanced.stages[0]
    assert stage == fast.stages[0]
    weights = {"pose_prior": 30, "velocity": 50}
    settings = fast.stage_settings(stage)
    changed = {name: settings[name] | {"weight": weight} for name, weight in weights.items()}
    assert balanced.stage_settings(stage) == settings | changed


def test_a_removed_key_is_an_error_that_says_what_to_do(tmp_path):
    with pytest.raises(InputError, match=r"grow_masks_px.* was removed.*set `edge: unbiased`"):
        load_config(written(tmp_path, "base: map\ngrow_masks_px: 2\n"))


def test_stage_settings_override_defaults_then_terms():
    stage = StageConfig("s", 1, ("keypoints", "velocity"), override={"keypoints": {"sigma_px": 5}, "velocity": 2})
    config = FitConfig((stage,), {"keypoints": {"weight": 3, "sigma_px": 7}})
    settings = config.stage_settings(stage)
    assert settings["keypoints"] == {"weight": 3, "sigma_px": 5}
    assert settings["velocity"] == {"weight": 2, **find_term("velocity").settings}
    plain = dataclasses.replace(stage, override={})
    assert config.stage_settings(plain)["keypoints"] == {"weight": 3, "sigma_px": 7}
    assert config.stage_settings(plain)["velocity"]["weight"] == 1


STAGE = "stages: [{name: a, steps: 1, terms: [keypoints]%s}]\nterms: {}\n"
LEAST_SQUARES = STAGE.replace("steps: 1", "steps: 1, solver: levenberg_marquardt")


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("base: paper\nwindws: 3\n", ["`windws`", "window"]),
        ("base: paper\ncrop: {pading: 3}\n", ["`crop.pading`", "padding"]),
        ("base: paper\ninitialise: {turn: 3}\n", ["`initialise.turn`", "turns"]),
        (STAGE % ", step: 3", ["`stages[0].step`", "steps"]),
        ("base: paper\nterms: {keypoint: 1}\n", ["`terms.keypoint`", "keypoints"]),
        ("base: paper\nterms: {keypoints: {sigma: 1}}\n", ["`terms.keypoints.sigma`", "sigma_px"]),
        (STAGE.replace("keypoints", "keypoint") % "", ["`stages[0].terms`", "keypoint", "did you mean keypoints"]),
        (STAGE % ", override: {masks: 1}", ["`stages[0].override.masks`", "mask_smooth_l1"]),
        (STAGE % ", override: {mask: {sigma_px: 1}}", ["`stages[0].override.mask.sigma_px`", "weight"]),
        (STAGE % ", optimised: [body]", ["`stages[0].optimised`", "body_pose"]),
        (STAGE % ", step_scale: {depth: 1}", ["`stages[0].step_scale`", "transl"]),
        (STAGE % ", step_scale: {transl: [1, 1]}", ["`stages[0].step_scale.transl`", "three"]),
        (STAGE % ", step_scale: {scale: [1, 1, 1]}", ["`stages[0].step_scale.scale`"]),
        (STAGE % ", step_scale: {scale: fast}", ["`stages[0].step_scale.scale`", "fast"]),
        (STAGE % ", step_scale: {scale: true}", ["`stages[0].step_scale.scale`", "true"]),
        (STAGE % ", step_scale: {scale: -1}", ["`stages[0].step_scale.scale`", "-1"]),
        ("base: paper\nwindow: ten\n", ["`window`", "ten", "int"]),
        ("base: paper\nwindow: 1.5\n", ["`window`", "1.5", "int"]),
        ("base: paper\nwindow: true\n", ["line 2: `window`", "true", "int"]),
        ("base: paper\nmemory_gb: true\n", ["`memory_gb`", "true", "float"]),
        ("base: paper\ncommon_size: 1\n", ["`common_size`", "1", "bool"]),
        ("base: paper\nwindow:\n", ["`window`", "null", "int"]),
        ("base: paper\nterms: {mask: true}\n", ["`terms.mask.weight`", "true"]),
        ("base: paper\nterms: {mask: heavy}\n", ["`terms.mask.weight`", "heavy"]),
        ("base: paper\nterms: {mask: -1}\n", ["`terms.mask.weight`", "-1"]),
        ("base: paper\nterms: {mask: .nan}\n", ["`terms.mask.weight`", "nan"]),
        ("base: paper\nterms: {mask: .inf}\n", ["`terms.mask.weight`", "inf"]),
        ("base: paper\nterms: {keypoints: {sigma_px: 0}}\n", ["`terms.keypoints.sigma_px`", "0"]),
        ("base: paper\nterms: [mask]\n", ["`terms`", "mapping"]),
        ("base: paper\nstages: {}\n", ["`stages`", "list"]),
        ("base: paper\nstages: []\n", ["`stages`", "empty"]),
        ("base: paper\nstages: [mask]\n", ["line 2: `stages[0]`", "mapping", "'mask'"]),
        ("base: paper\nbackend: cuda\n", ["`backend`", "cuda", "native"]),
        ("base: paper\ncrop: {mode: round}\n", ["`crop.mode`", "round", "box"]),
        ("base: paper\ncrop: 7\n", ["crop", "mapping"]),
        ("base: paper\nfilter_window: 4\n", ["`filter_window`", "4", "odd"]),
        ("base: paper\nwindow: 0\n", ["`window`", "0"]),
        ("base: paper\nmemory_gb: 0\n", ["`memory_gb`", "0"]),
        ("base: paper\nmin_keypoints: 0\n", ["`min_keypoints`", "0"]),
        ("base: paper\ncrop: {size_px: 0}\n", ["`crop.size_px`", "0"]),
        ("base: paper\ncrop: {padding: .inf}\n", ["`crop.padding`", "inf"]),
        ("base: paper\ncrop: {focal_px: .nan}\n", ["`crop.focal_px`", "nan"]),
        ("base: paper\nwindow: 1000000000\n", ["`window` is 1000000000 (expected 1 to 10,000)"]),
        ("base: paper\ncrop: {size_px: 1000000}\n", ["`crop.size_px` is 1000000 (expected 16 to 1,024)"]),
        ("base: paper\ncrop: {padding: 1.0e+300}\n", ["`crop.padding`", "10"]),
        ("base: paper\ncrop: {focal_px: 1.0e+300}\n", ["`crop.focal_px`"]),
        ("base: paper\nfilter_window: 1000001\n", ["`filter_window`", "1,001"]),
        ("base: paper\nmin_keypoints: 100000\n", ["`min_keypoints`"]),
        ("base: paper\nmemory_gb: 1.0e+300\n", ["`memory_gb` is 1e+300 (expected a number above 0, at most 1000)"]),
        ("base: paper\ninitialise: {turns: 1000000}\n", ["`initialise.turns`"]),
        ("base: paper\ninitialise: {directions: 1000000}\n", ["`initialise.directions`"]),
        ("base: paper\ninitialise: {candidates: 1000000}\n", ["`initialise.candidates`"]),
        ("base: paper\ninitialise: {hypotheses: 1000000}\n", ["`initialise.hypotheses`"]),
        ("base: paper\ninitialise: {smoothness: 1.0e+300}\n", ["`initialise.smoothness`"]),
        ("base: paper\ninitialise: {method: so3, turns: 3000}\n", ["`initialise.directions`", "300,000 orientations"]),
        ("base: paper\nterms: {mask: 1.0e+300}\n", ["`terms.mask.weight`", "1e+300"]),
        (STAGE % ", step_scale: {scale: 1.0e+300}", ["`stages[0].step_scale.scale`"]),
        (STAGE % ", learning_rate: 1.0e+300", ["`stages[0].learning_rate`"]),
        (STAGE % ", blur: 1000", ["`stages[0].blur`"]),
        ((STAGE % "").replace("steps: 1", "steps: 1000000000"), ["`stages[0].steps`", "100,000"]),
        (
            f"terms: {{}}\nstages: [{', '.join(['{name: a, steps: 1, terms: [mask]}'] * 51)}]\n",
            ["`stages`", "51", "50"],
        ),
        (STAGE % ", learning_rate: .inf", ["`stages[0].learning_rate`", "inf"]),
        ("base: paper\ncrop: {focal_px: -1}\n", ["`crop.focal_px`", "-1"]),
        ("base: paper\ninitialise: {hypotheses: 0}\n", ["`initialise.hypotheses`", "0"]),
        ("base: paper\ninitialise: {smoothness: -1}\n", ["`initialise.smoothness`", "-1"]),
        ((STAGE % "").replace("steps: 1", "steps: 0"), ["`stages[0].steps`", "0"]),
        (STAGE % ", learning_rate: 0", ["`stages[0].learning_rate`", "0"]),
        (STAGE % ", solver: newton", ["`stages[0].solver`", "newton", "levenberg_marquardt"]),
        (LEAST_SQUARES % ", carry_moments: true", ["`stages[0].carry_moments`", "Adam"]),
        (STAGE % ", blur: 0", ["`stages[0].blur`", "0"]),
        ("window: 3\n", ["`stages`", "missing", "base: paper"]),
        ("stages: [{name: a, terms: [mask]}]\nterms: {}\n", ["`stages[0].steps`", "missing"]),
        ("base: papr\n", ["papr", "paper"]),
        ("- a\n- b\n", ["mapping"]),
        ("", ["mapping"]),
        ("window: [1,\n", ["YAML"]),
        ("window: !!python/object/apply:os.getcwd []\n", ["YAML"]),
    ],
    ids=lambda value: value[0].strip("`") if isinstance(value, list) else "",
)
def test_errors_name_the_key(tmp_path, text, names):
    path = written(tmp_path, text)
    with pytest.raises(InputError) as caught:
        load_config(path)
    message = str(caught.value)
    if "papr" not in text:  # there the base is the unreadable file
        assert message.startswith(f"{path}: ")
    assert "\n" not in message
    for name in names:
        assert name in message, f"{name!r} is not in {message!r}"


@pytest.mark.parametrize(
    ("base", "top", "expected_file"),
    [
        ("windws: 3", "window: 5", "base"),
        ("window: ten", "filter_window: 1", "base"),
        ("window: 0", "filter_window: 1", "base"),
        ("window: 10", "window: 0", "top"),
        ("crop: {padding: -1}", "crop: {size_px: 64}", "base"),
        ("crop: {padding: 1}", "crop: {padding: -1}", "top"),
        ("crop: {pading: 1}", "crop: {padding: 1}", "base"),
        ("crop: {padding: 1}", "crop: 7", "top"),
        ("crop: 7", "window: 3", "base"),
        ("terms: {mask: -1}", "terms: {velocity: 1}", "base"),
        ("terms: {keypoints: {sigma_px: 0}}", "terms: {keypoints: {weight: 2}}", "base"),
        ("terms: {keypoints: {weight: 2}}", "terms: {keypoints: -1}", "top"),
        ("terms: {keypoints: {weight: 2}}", "terms: {keypoints: {sigma_px: 0}}", "top"),
        ("stages: [{name: a, steps: 0, terms: [mask]}]", "window: 3", "base"),
        ("stages: [{name: a, terms: [mask]}]", "window: 3", "base"),
        ("stages: []", "stages: [{name: a, steps: 1, terms: [masks]}]", "top"),
        ("window: [1,", "window: 3", "base"),
    ],
)
def test_errors_in_a_base_name_the_base(tmp_path, base, top, expected_file):
    """Two files over a shipped config; the error names the file that sets the key."""
    files = {"base": written(tmp_path, f"base: paper\n{base}\n", "base.yaml")}
    files["top"] = written(tmp_path, f"base: base.yaml\n{top}\n", "top.yaml")
    with pytest.raises(InputError) as caught:
        load_config(files["top"])
    assert str(caught.value).startswith(f"{files[expected_file]}: ")


def test_a_missing_key_is_reported_for_the_top_file(tmp_path):
    written(tmp_path, "window: 3\n", "base.yaml")
    with pytest.raises(InputError, match=r"top\.yaml: `stages` is missing"):
        load_config(written(tmp_path, "base: base.yaml\n", "top.yaml"))


def test_a_config_made_in_code_is_checked():
    with pytest.raises(InputError, match="`window` is 0"):
        dataclasses.replace(load_config("paper"), window=0)


def test_bases_in_a_circle(tmp_path):
    a = written(tmp_path, "base: b.yaml\n", "a.yaml")
    written(tmp_path, "base: a.yaml\n", "b.yaml")
    with pytest.raises(InputError, match=r"circle.*a\.yaml.*b\.yaml"):
        load_config(a)


def test_unreadable_files(tmp_path):
    with pytest.raises(InputError, match=r"absent\.yaml.*(paper.*)+"):
        load_config(tmp_path / "absent.yaml")
    with pytest.raises(InputError, match="is a folder, not a YAML file"):
        load_config(tmp_path)
    (tmp_path / "latin.yaml").write_bytes(b"name: \xff\xfe\x00")
    with pytest.raises(InputError, match=r"latin\.yaml"):
        load_config(tmp_path / "latin.yaml")


def test_every_term_has_a_docstring():
    for name in known_terms():
        documented = find_term(name).function.__doc__
        assert documented, name
        assert len(documented.strip()) > 20, name
        assert "Source:" in documented or name == "shape_prior", name


def test_map_starts_with_a_wide_scale_of_motion():
    """With the scale of the last stage in the first stage, wingbeats would be rounded off from the start."""
    config = load_config("map")
    scales = [config.stage_settings(stage)["motion_likelihood"]["sd_rad_s2"] for stage in config.stages]
    assert scales == [62.5, 6.25]
    assert (config.filter_window, config.unknown_pixels, config.edge) == (1, True, "unbiased")
