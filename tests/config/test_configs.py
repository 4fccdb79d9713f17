"""Configs: shipped values, bases, and one table of bad configs, whose error names file, line, key and remedy."""

import dataclasses
import pickle
import typing

import pytest

from jaxfit.config.build import build_config, field_help, plain_config
from jaxfit.config.checks import ConfigKeyError
from jaxfit.config.fit import FitConfig, StageConfig, load_config, shipped_fit_configs
from jaxfit.config.perception import SegmenterConfig, TrackConfig
from jaxfit.config.reconstruct import OverlayConfig, ReconstructConfig, load_reconstruct_config
from jaxfit.config.yaml_file import _shipped_folder, config_to_yaml, documented_yaml, read_yaml_file
from jaxfit.evaluation.ablation.grid import GridConfig
from jaxfit.foundation.errors import InputError
from jaxfit.objective.registry import find_term, known_terms

PAPER = load_config("paper")


def written(tmp_path, text, name="mine.yaml"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_the_paper_and_its_baseline():
    baseline = load_config("baseline")
    assert (PAPER.window, PAPER.common_size, PAPER.filter_window) == (100, True, 5)
    assert [(s.steps, s.learning_rate) for s in PAPER.stages] == [(600, 0.01), (400, 0.01)]
    assert [("mask" in s.terms) for s in PAPER.stages] == [False, True]
    assert all(s.step_scale["transl"][2] == 0 for s in PAPER.stages)  # depth is fixed
    settings = PAPER.stage_settings(PAPER.stages[1])
    weights = {"keypoints": 1, "mask": 1, "pose_prior": 100, "velocity": 100, "acceleration": 100}
    assert {name: values["weight"] for name, values in settings.items()} == weights
    assert settings["keypoints"]["sigma_px"] == 50
    assert (settings["velocity"]["beta_global"], settings["velocity"]["beta_pose"]) == (10, 1)
    assert dataclasses.replace(baseline, window=100, common_size=True, filter_window=5) == PAPER


def test_fast_and_map():
    fast, config = (load_config(name) for name in ("fast", "map"))
    assert (config.unknown_pixels, config.edge, config.overlap) == (True, "unbiased", 20)
    assert (fast.unknown_pixels, fast.edge) == (False, "soft_rasterizer")  # the paper's objective
    assert fast.stage_settings(fast.stages[1]) == PAPER.stage_settings(PAPER.stages[1])
    # with the scale of the last stage in the first stage, wingbeats would be rounded off from the start
    scales = [config.stage_settings(stage)["motion_likelihood"]["sd_rad_s2"] for stage in config.stages]
    assert scales == [62.5, 6.25, 6.25, 6.25]


@pytest.mark.parametrize("name", shipped_fit_configs())
def test_round_trip(tmp_path, name):
    config = load_config(name)
    assert load_config(written(tmp_path, config_to_yaml(config))) == config
    assert pickle.loads(pickle.dumps(config)) == config  # configs travel to workers


def test_reconstruct_holds_no_defaults_and_reads_back(tmp_path):
    config = load_reconstruct_config()
    fit = dataclasses.replace(load_config("map"), filter_window=5, error_bars=False)
    assert (config.track, config.overlay, config.fit) == (TrackConfig(), OverlayConfig(), fit)
    text = documented_yaml(config)
    assert load_reconstruct_config(written(tmp_path, text)) == config
    lines = [line.strip() for line in text.splitlines()]
    assert lines[lines.index("tile_overlap: 0.25") - 1].startswith("# Overlap of neighbouring tiles")
    assert lines.count("# Number of steps of the solver.") == 1  # only in the first stage


def fields_of(kind):
    """Yield the class and the field of every setting below a config class."""
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        yield kind, field
        for inner in (hints[field.name], *typing.get_args(hints[field.name])):
            if dataclasses.is_dataclass(inner):
                yield from fields_of(inner)


@pytest.mark.parametrize("kind", [ReconstructConfig, GridConfig])
def test_every_setting_has_a_description(kind):
    for owner, field in fields_of(kind):
        own_config = dataclasses.is_dataclass(typing.get_type_hints(owner)[field.name])
        assert own_config or field_help(owner)[field.name], f"{owner.__name__}.{field.name}"


def test_every_term_has_a_docstring():
    for name in known_terms():
        documented = find_term(name).function.__doc__
        assert documented, name
        assert len(documented.strip()) > 20, name
        assert "Source:" in documented or name == "shape_prior", name


def test_a_file_overrides_its_base_key_by_key(tmp_path):
    written(tmp_path, "base: paper\nwindow: 20\nterms: {velocity: 7}\n", "below.yaml")
    path = written(tmp_path, "base: below.yaml\ncrop: {padding: 1}\nterms: {keypoints: {sigma_px: 9}}\n")
    config = load_config(path)
    assert config.crop == dataclasses.replace(PAPER.crop, padding=1.0)
    assert isinstance(config.crop.padding, float)  # whole numbers are accepted for fractions
    terms = {**PAPER.terms, "velocity": 7, "keypoints": {"weight": 1, "sigma_px": 9}}
    assert dataclasses.replace(config, crop=PAPER.crop) == dataclasses.replace(PAPER, window=20, terms=terms)


def test_which_file_a_base_is(tmp_path, monkeypatch):
    written(tmp_path, "base: baseline\nwindow: 3\n", "beside.yaml")
    assert load_config(written(tmp_path, "base: beside.yaml\n")).window == 3
    assert load_config(written(tmp_path, "base: baseline\n")).window == 1
    written(tmp_path, "window: -1\n", "paper")
    monkeypatch.chdir(tmp_path)
    assert load_config("baseline").window == 1  # the base of a shipped config is shipped


@pytest.mark.parametrize(
    ("text", "of", "changes"),
    [
        ("fit: baseline", "baseline", {}),
        ("fit: {base: baseline, window: 3}", "baseline", {"window": 3}),
        ("base: reconstruct\nfit: {window: 3}", "map", {"window": 3, "filter_window": 5, "error_bars": False}),
        ("base: reconstruct\nfit: beside.yaml", "baseline", {"window": 4}),
        ("base: middle.yaml\nfit: {common_size: true}", "baseline", {"window": 4, "common_size": True}),
    ],
)
def test_the_fit_has_a_base_of_its_own(tmp_path, text, of, changes):
    written(tmp_path, "base: baseline\nwindow: 4\n", "beside.yaml")
    written(tmp_path, "fit: {base: beside.yaml}\n", "middle.yaml")
    fit = load_reconstruct_config(written(tmp_path, text)).fit
    assert fit == dataclasses.replace(load_config(of), **changes)


def test_stage_settings_override_defaults_then_terms():
    stage = StageConfig("s", 1, ("keypoints", "velocity"), override={"keypoints": {"sigma_px": 5}, "velocity": 2})
    config = FitConfig((stage,), {"keypoints": {"weight": 3, "sigma_px": 7}})
    settings = config.stage_settings(stage)
    assert settings["keypoints"] == {"weight": 3, "sigma_px": 5}
    assert settings["velocity"] == {"weight": 2, **find_term("velocity").settings}
    plain = dataclasses.replace(stage, override={})
    assert config.stage_settings(plain)["keypoints"] == {"weight": 3, "sigma_px": 7}


STAGE = "terms: {}\nstages:\n  - {name: a, steps: 1, terms: [keypoints]%s}\n"
BAD_FIT = [
    ("base: paper\n\nwindws: 3\n", "line 3: `windws` is not a known key (did you mean window? known: window, "),
    ("base: map\ngrow_masks_px: 2\n", "`grow_masks_px` was removed (remove the key and set `edge: unbiased`)"),
    ("base: paper\nterms:\n  masc: 2\n", "line 3: `terms.masc` names an unknown term 'masc' (did you mean mask?"),
    ("base: paper\nterms: {keypoints: {sigma: 1}}\n", "`terms.keypoints.sigma` is not a setting of this term (did you"),
    (STAGE % ", override: {mask: {sigma_px: 1}}", "`stages[0].override.mask.sigma_px` is not a setting of this term"),
    (STAGE % ", optimised: [body]", "`stages[0].optimised[0]` is \"body\" (expected 'global_orient', 'body_pose'"),
    (STAGE % ", step_scale: {depth: 1}", "`stages[0].step_scale.depth`"),
    (STAGE % ", step_scale: {transl: [1, 1]}", "`stages[0].step_scale.transl` is [1.0, 1.0] (expected a number, 0 or"),
    (STAGE % ", solver: levenberg_marquardt, carry_moments: true", "`stages[0].carry_moments` is true"),
    (STAGE % ", blur: 0", "`stages[0].blur` is 0 (expected a number above 0)"),
    (STAGE % ", learning_rate: .inf", "`stages[0].learning_rate` is Infinity (expected a finite number)"),
    ("base: paper\nwindow: ten\n", 'line 2: `window` is "ten" (expected a whole number)'),
    ("base: paper\nwindow: true\n", "`window` is true (expected a whole number)"),
    ("base: paper\nwindow: 0\n", "`window` is 0 (expected a number above 0)"),
    ("base: paper\ncommon_size: yes\n", '`common_size` is "yes" (expected true or false)'),
    ("base: paper\nfilter_window: 4\n", "`filter_window` is 4 (expected an odd number of frames"),
    ("base: paper\nterms: {mask: true}\n", "`terms.mask.weight` is true (expected a number, 0 or more)"),
    ("base: paper\nterms: {mask: -1}\n", "`terms.mask.weight` is -1"),
    ("base: paper\nterms: {keypoints: {sigma_px: 0}}\n", "`terms.keypoints.sigma_px` is 0 (expected a number above 0)"),
    ("base: paper\nterms: null\n", "line 2: `terms` is null (expected a mapping of keys to values)"),
    ("base: paper\nstages: []\n", "`stages` is [] (expected at least 1 value)"),
    ("base: paper\nstages: [mask]\n", 'line 2: `stages[0]` is "mask" (expected a mapping of keys to values)'),
    ("base: paper\ncrop:\n  mode: image\n  padding: -1\n", "line 4: `crop.padding` is -1 (expected 0 or more)"),
    ("base: paper\nlearn_weights: [mask]\n", "`learn_weights[0]` is \"mask\" (expected 'keypoint_likelihood'"),
    ("base: paper\nkeypoint_offsets: {crown: [1, 2]}\n", "`keypoint_offsets.crown` has 2 numbers"),
    ("window: 3\n", "`stages` is missing (add the key, or start from `base: paper`)"),
    ("base: paper\nstages:\n- {name: a, terms: [mask]}", "line 3: `stages[0].steps` is missing (add the key)"),
    ("base: papr\n", "line 1: `base` names 'papr', which does not exist (give a YAML file or one of ablation, aves, "),
    ("window: 3\nbase: [paper]\n", 'line 2: `base` is ["paper"] (expected the name'),
    (f"base: {'x' * 5000}\n", "which does not exist"),
    ("base: mine.yaml\n", "the `base` keys form a circle (mine.yaml → mine.yaml)"),
    ("base: s\n", "is a folder, not a YAML file"),
    ("window: [1,\n", "line 2 is not valid YAML"),
]
BAD_RECONSTRUCT = [
    ("fits: paper", "line 2: `fits` is not a known key (did you mean fit?"),
    ("track: {segmentor: x}", "`track.segmentor` is not a known key (did you mean segmenter?"),
    ("track: {segmenter: {classes: bird}}", '`track.segmenter.classes` is "bird" (expected a list)'),
    ("track: {segmenter: {tile_overlap: 1}}", "`track.segmenter.tile_overlap` is 1 (expected 0.9 or less)"),
    ("track: {frames: {start: 9, stop: 9}}", "`track.frames.stop` is 9, and `start` is 9 (expected a frame after"),
    ("track: {frames: {step: 0}}", "`track.frames.step` is 0 (expected a number above 0)"),
    ("overlay: {codec: gif}", "`overlay.codec` is \"gif\" (expected 'auto', 'h264', "),
    ("fit: {terms: {mask: -1}}", "`fit.terms.mask.weight` is -1"),
    ("fit: absent.yaml", "line 2: `fit` names 'absent.yaml', which does not exist"),
    ("fit: {base: mine.yaml}", "the `base` keys form a circle"),
]


@pytest.mark.parametrize(
    ("load", "text", "message"),
    [(load_config, *case) for case in BAD_FIT]
    + [(load_reconstruct_config, f"base: reconstruct\n{text}", message) for text, message in BAD_RECONSTRUCT],
    ids=lambda value: value[:30] if isinstance(value, str) else "",
)
def test_a_bad_config_is_one_line(tmp_path, load, text, message):
    (tmp_path / "s").mkdir()
    path = written(tmp_path, text)
    with pytest.raises(InputError) as caught:
        load(path)
    assert message in str(caught.value)
    assert str(caught.value).startswith(str(tmp_path))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) <= 300


@pytest.mark.parametrize(
    ("base", "top", "expected_file"),
    [
        ("windws: 3", "window: 5", "base"),
        ("window: 0", "filter_window: 1", "base"),
        ("window: 10", "window: 0", "top"),
        ("crop: {padding: -1}", "crop: {size_px: 64}", "base"),
        ("crop: {padding: 1}", "crop: {padding: -1}", "top"),
        ("crop: {padding: 1}", "crop: 7", "top"),
        ("terms: {keypoints: {sigma_px: 0}}", "terms: {keypoints: {weight: 2}}", "base"),
        ("terms: {keypoints: {weight: 2}}", "terms: {keypoints: -1}", "top"),
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


def test_errors_in_the_file_of_the_fit_name_that_file(tmp_path):
    fit = written(tmp_path, "base: paper\nwindow: 0\n", "fit.yaml")
    with pytest.raises(InputError) as caught:
        load_reconstruct_config(written(tmp_path, "base: reconstruct\nfit: fit.yaml\n"))
    assert str(caught.value).startswith(f"{fit}: line 2: `fit.window` is 0")


def test_configs_of_the_wrong_kind():
    with pytest.raises(InputError, match=r"paper: is the config of a fit.*fit: paper"):
        load_reconstruct_config("paper")
    with pytest.raises(InputError, match=r"reconstruct: line 6: `fit` is not a known key"):
        load_config("reconstruct")


def test_a_config_made_in_code_is_checked():
    with pytest.raises(InputError, match=r"`window` is 0 \(expected a number above 0\)"):
        dataclasses.replace(PAPER, window=0)
    with pytest.raises(InputError, match="`steps` is 0"):
        StageConfig("s", 0, ("keypoints",))
    with pytest.raises(InputError, match=r"`clases` is not a known key \(did you mean classes"):
        SegmenterConfig(clases=("bird",))
    with pytest.raises(dataclasses.FrozenInstanceError):
        PAPER.window = 3


def test_unreadable_files(tmp_path):
    (tmp_path / "latin.yaml").write_bytes(b"a: 3\nname: x\xff\xfe\x00")
    for source, words in [
        (tmp_path / "absent.yaml", r"absent\.yaml: does not exist.*paper"),
        (tmp_path, "is a folder, not a YAML file"),
        (tmp_path / "latin.yaml", r"latin\.yaml: line 2 is not UTF-8 text \(byte 12\) \(give a YAML file, saved as"),
        ("a\0b", "contains a character that no file name has"),
    ]:
        with pytest.raises(InputError, match=words):
            load_config(source)


def test_shipped_files_hold_only_overrides():
    """Every key of a shipped file changes a default or a value of the base."""
    for name in shipped_fit_configs():
        values = read_yaml_file(_shipped_folder() / f"{name}.yaml").values
        below = load_config(values["base"]) if "base" in values else FitConfig
        for key in values.keys() - {"base", "stages", "terms"}:
            assert getattr(load_config(name), key) != getattr(below, key), (name, key)


def test_configs_of_earlier_results_hold_removed_options():
    plain = plain_config(load_reconstruct_config())
    plain["track"]["repair_left_right_flips"] = False
    assert build_config(ReconstructConfig, plain) == load_reconstruct_config()
    plain["track"]["repair_left_right_flips"] = True
    with pytest.raises(ConfigKeyError, match=r"`track\.repair_left_right_flips` was removed \(remove the key"):
        build_config(ReconstructConfig, plain)
