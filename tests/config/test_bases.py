"""Bases of configs: what a base may be, circles and long chains, and errors that name file and line."""

import os

import pytest

from jaxfit.config.fit import load_config
from jaxfit.config.reconstruct import load_reconstruct_config
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import CONFIG_BASES


def written(folder, text, name="mine.yaml"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("base", "words"),
    [
        ("3", "line 2: `base` is 3 .expected the name"),
        ("[paper]", r"line 2: `base` is \['paper'\]"),
        ("{paper: 1}", r"line 2: `base` is \{'paper': 1\}"),
        ("", "line 2: `base` is null"),
        ("''", "line 2: `base` is ''"),
        (r'"a\0b"', r"line 2 holds the character U\+0000"),
        ("x" * 5000, "line 2: `base` names 'xxx.*does not exist"),
        ("loop.yaml", "`base` names 'loop.yaml', which does not exist"),
        ("absent.yaml", "`base` names 'absent.yaml', which does not exist.*paper"),
        (".", "is a folder, not a YAML file"),
        ("folder", "is a folder, not a YAML file"),
        ("pipe", "is a device or a pipe"),
        ("/dev/zero", "is a device or a pipe"),
    ],
)
def test_what_is_no_base(tmp_path, base, words):
    (tmp_path / "loop.yaml").symlink_to("loop.yaml")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    path = written(tmp_path, f"window: 3\nbase: {base}\n")
    with pytest.raises(InputError, match=words):
        load_config(path)
    with pytest.raises(InputError):
        load_reconstruct_config(written(tmp_path, f"base: reconstruct\nfit: {base}\n"))


def test_a_circle_through_other_paths(tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "link.yaml").symlink_to("mine.yaml")
    for base in ("s/../mine.yaml", "link.yaml", "./mine.yaml", str(tmp_path / "mine.yaml")):
        with pytest.raises(InputError, match=r"circle \(mine\.yaml → mine\.yaml\)"):
            load_config(written(tmp_path, f"base: {base}\n"))
    with pytest.raises(InputError, match="circle"):
        load_reconstruct_config(written(tmp_path, "fit: {base: mine.yaml}\n"))


def test_the_longest_chain(tmp_path):
    files = 2 * CONFIG_BASES
    for i in range(files):
        base = f"{i + 1}.yaml" if i < files - 1 else "paper"
        written(tmp_path, f"base: {base}\nwindow: {i + 1}\n", f"{i}.yaml")
    most = files - (CONFIG_BASES - 1)  # `paper` is the last file
    assert load_config(tmp_path / f"{most}.yaml").window == most + 1
    with pytest.raises(InputError, match=rf"is base number {CONFIG_BASES}"):
        load_config(tmp_path / f"{most - 1}.yaml")
    with pytest.raises(InputError, match=r"20\.yaml: is base number 20"):
        load_config(tmp_path / "0.yaml")


def test_the_base_of_a_shipped_config_is_shipped(tmp_path, monkeypatch):
    written(tmp_path, "window: -1\n", "paper")
    monkeypatch.chdir(tmp_path)
    assert load_config("baseline").window == 1


def test_names_that_no_file_can_have(tmp_path):
    for name in ("x" * 300 + ".yaml", "a\0b", "a\ud800", ""):
        with pytest.raises(InputError, match=r"does not exist|is a folder"):
            load_config(tmp_path / name if name else name)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("base: paper\n\nwindws: 3\n", r"line 3: `windws` is not a known key \(did you mean window\? known: window, "),
        ("base: paper\nwindow: ten\n", "line 2: `window` is 'ten'"),
        ("base: paper\ncrop:\n  mode: image\n  padding: -1\n", "line 4: `crop.padding` is -1"),
        (
            "base: paper\nstages:\n- {name: a, steps: 1, terms: [mask]}\n- {name: a, terms: [mask]}",
            "line 4: `stages.1.*missing",
        ),
        ("base: paper\nterms:\n  mask: 1\n  masc: 2\n", "line 4: `terms.masc` names an unknown term 'masc'.*mean mask"),
        (
            "base: paper\nterms: {mask: 1.0e+300}\n",
            r"line 2: `terms.mask.weight` is 1e\+300 \(expected a number from 0 to 1e\+30\)",
        ),
        ("base: paper\nwindow: [" + "1," * 30000 + "]\n", r"`window` is \[1, 1, 1, 1, \.\.\.\]"),
        ("base: paper\nterms: null\n", "`terms` must be a mapping, not null"),
    ],
)
def test_errors_name_the_line(tmp_path, text, words):
    path = written(tmp_path, text)
    with pytest.raises(InputError, match=words) as caught:
        load_config(path)
    assert str(caught.value).startswith(f"{path}: line ")
    assert len(str(caught.value)) <= 300
