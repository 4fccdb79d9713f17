"""The config of a reconstruction: shipped values, descriptions, the base of the fit, and errors that name the key."""

import dataclasses
import typing

import pytest

from jaxfit.config.build import field_help
from jaxfit.config.fit import load_config
from jaxfit.config.perception import TrackConfig
from jaxfit.config.reconstruct import OverlayConfig, ReconstructConfig, load_reconstruct_config
from jaxfit.config.yaml_file import _parse, config_to_yaml, documented_yaml
from jaxfit.evaluation.ablation.grid import GridConfig
from jaxfit.foundation.errors import InputError


def written(tmp_path, text, name="mine.yaml"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_the_shipped_file_holds_no_defaults():
    config = load_reconstruct_config()
    assert (config.track, config.overlay, config.fit) == (TrackConfig(), OverlayConfig(), load_config("balanced"))
    assert set(_parse("reconstruct").values) == {"fit"}
    assert not config.track.repair_left_right_flips  # the paper's setting


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
        assert own_config or field_help(owner).get(field.name), f"{owner.__name__}.{field.name}"


def test_the_documented_text_describes_every_setting_and_reads_back(tmp_path):
    text = documented_yaml(load_reconstruct_config())
    assert load_reconstruct_config(written(tmp_path, text)) == load_reconstruct_config()
    lines = [line.strip() for line in text.splitlines()]
    assert lines[lines.index("tile_overlap: 0.25") - 1].startswith("# Overlap of neighbouring tiles")
    assert lines.count("# Number of steps of the solver, at most 100,000.") == 1  # only in the first stage


def test_round_trip(tmp_path):
    text = "base: reconstruct\nfit: aves\ntrack: {frames: {stop: 7}, segmenter: {classes: [bird], tile_px: 640}}\n"
    config = load_reconstruct_config(written(tmp_path, text))
    assert load_reconstruct_config(written(tmp_path, config_to_yaml(config), "again.yaml")) == config
    assert config.track.frames.stop == 7
    assert config.track.segmenter.classes == ("bird",)
    assert config.fit == load_config("aves")  # no value of the paper's config is left


@pytest.mark.parametrize(
    ("text", "of", "changes"),
    [
        ("fit: baseline", "baseline", {}),
        ("fit: {base: baseline, window: 3}", "baseline", {"window": 3}),
        ("base: reconstruct\nfit: {window: 3}", "balanced", {"window": 3}),
        ("base: reconstruct\nfit: own.yaml", "baseline", {"window": 4}),
        ("base: middle.yaml\nfit: {common_size: true}", "baseline", {"window": 4, "common_size": True}),
    ],
)
def test_the_fit_has_a_base_of_its_own(tmp_path, text, of, changes):
    written(tmp_path, "base: baseline\nwindow: 4\n", "own.yaml")
    written(tmp_path, "fit: {base: own.yaml}\n", "middle.yaml")
    fit = load_reconstruct_config(written(tmp_path, text)).fit
    assert fit == dataclasses.replace(load_config(of), **changes)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("fits: paper", ["`fits`", "track"]),
        ("track: {segmentor: x}", ["`track.segmentor`", "segmenter"]),
        ("track: {segmenter: {path: x}}", ["`track.segmenter.path`", "file"]),
        ("track: {segmenter: {classes: bird}}", ["`track.segmenter.classes`", "list"]),
        ("track: {segmenter: {min_score: 2.5}}", ["`track.segmenter.min_score`", "2", "within 0 and 1"]),
        ("track: {segmenter: {min_score: .nan}}", ["`track.segmenter.min_score`", "nan"]),
        ("track: {segmenter: {tile_px: 8}}", ["`track.segmenter.tile_px`", "8"]),
        ("track: {segmenter: {tile_px: wide}}", ["`track.segmenter.tile_px`", "wide", "int"]),
        ("track: {segmenter: {tile_overlap: 1}}", ["`track.segmenter.tile_overlap`"]),
        ("track: {keypoints: {batch: 0}}", ["`track.keypoints.batch`", "0"]),
        ("track: {keypoints: {pad_px: -1}}", ["`track.keypoints.pad_px`", "-1"]),
        ("track: {tracker: {memory: -1}}", ["`track.tracker.memory`", "-1"]),
        ("track: {tracker: {min_iou: 3}}", ["`track.tracker.min_iou`", "3"]),
        ("track: {frames: {start: 9, stop: 9}}", ["`track.frames.stop`", "9"]),
        ("track: {frames: {step: 0}}", ["`track.frames.step`", "0"]),
        ("track: {min_track_frames: 0}", ["`track.min_track_frames`", "0"]),
        ("track: {threads: 0}", ["`track.threads`", "0"]),
        ("track: {threads: 1000000}", ["`track.threads`", "1,024, or null"]),
        ("track: {min_track_frames: 10000000000}", ["`track.min_track_frames`"]),
        ("track: {frames: {start: 10000000000}}", ["`track.frames.start`"]),
        ("track: {frames: {stop: 10000000000}}", ["`track.frames.stop`"]),
        ("track: {frames: {step: 10000000000}}", ["`track.frames.step`"]),
        ("track: {tracker: {memory: 1000000000}}", ["`track.tracker.memory`"]),
        ("track: {keypoints: {batch: 1000000}}", ["`track.keypoints.batch`"]),
        ("track: {keypoints: {pad_px: 1000000}}", ["`track.keypoints.pad_px`"]),
        ("track: {keypoints: {dilate_px: 1000000}}", ["`track.keypoints.dilate_px`"]),
        ("track: {segmenter: {tile_px: 1000000}}", ["`track.segmenter.tile_px`"]),
        ("track: {segmenter: {tile_overlap: 0.99999}}", ["`track.segmenter.tile_overlap`", "0.9"]),
        ("overlay: {max_width_px: 1000000}", ["`overlay.max_width_px`"]),
        ("track: 7", ["track", "mapping"]),
        ("overlay: {max_width_px: 3}", ["`overlay.max_width_px`", "3"]),
        ("overlay: {codec: gif}", ["`overlay.codec`", "gif", "h264"]),
        ("fit: {window: 0}", ["`fit.window`", "0"]),
        ("fit: {terms: {mask: -1}}", ["`fit.terms.mask.weight`", "-1"]),
        ("fit: {stage: []}", ["`fit.stage`", "stages"]),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_errors_name_the_key(tmp_path, text, names):
    path = written(tmp_path, f"base: reconstruct\n{text}\n")
    with pytest.raises(InputError) as caught:
        load_reconstruct_config(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    for name in names:
        assert name in message, f"{name!r} is not in {message!r}"


def test_errors_in_the_file_of_the_fit_name_that_file(tmp_path):
    fit = written(tmp_path, "base: paper\nwindow: 0\n", "fit.yaml")
    with pytest.raises(InputError) as caught:
        load_reconstruct_config(written(tmp_path, "base: reconstruct\nfit: fit.yaml\n"))
    assert str(caught.value).startswith(f"{fit}: line 2: `fit.window` is 0")


def test_configs_of_the_wrong_kind():
    with pytest.raises(InputError, match=r"paper: is the config of a fit.*fit: paper"):
        load_reconstruct_config("paper")
    with pytest.raises(InputError, match=r"reconstruct: line 4: `fit` is not a known key"):
        load_config("reconstruct")


def test_a_missing_fit_and_a_circle_of_bases(tmp_path):
    with pytest.raises(InputError, match=r"`fit` is missing.*base: reconstruct"):
        load_reconstruct_config(written(tmp_path, "track: {threads: 2}\n"))
    written(tmp_path, "base: below.yaml\n", "below.yaml")
    with pytest.raises(InputError, match=r"circle"):
        load_reconstruct_config(written(tmp_path, "fit: below.yaml\n"))
