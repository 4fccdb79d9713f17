"""The name of the distribution differs from that of other software in the package index, and is asked in one place."""

import json
import re
import subprocess
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from jaxfit.cli import doctor
from jaxfit.foundation import extras
from jaxfit.foundation.extras import DISTRIBUTION, install_command, library_versions, other_jaxfit, own_version

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture
def installed(monkeypatch):
    """Replace the installed distributions by name → (version, value of the console script or None)."""

    class Installed(metadata.Distribution):
        def __init__(self, name, version, command):
            self._files = {"METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"}
            self._files["entry_points.txt"] = f"[console_scripts]\njaxfit = {command}\n" if command else None

        def read_text(self, filename):
            return self._files.get(filename)

        def locate_file(self, path):
            return Path(path)

    present = {}

    def distribution(name):
        if name not in present:
            raise metadata.PackageNotFoundError(name)
        return Installed(name, *present[name])

    monkeypatch.setattr(extras.metadata, "distribution", distribution)
    monkeypatch.setattr(extras.metadata, "version", lambda name: distribution(name).version)
    return present


def test_the_name_is_that_of_the_project():
    assert PROJECT["name"] == DISTRIBUTION != "jaxfit"
    assert PROJECT["scripts"]["jaxfit"] == extras._COMMAND


def test_the_version_is_that_of_the_distribution_or_of_the_checkout(installed, monkeypatch, tmp_path):
    installed["jaxfit"] = "0.0.5", None
    assert own_version() == PROJECT["version"]
    installed[DISTRIBUTION] = "7.1", extras._COMMAND
    assert own_version() == "7.1"
    assert library_versions(["jaxfit"]) == {"jaxfit": "7.1"}
    del installed[DISTRIBUTION]
    (tmp_path / "site" / "jaxfit").mkdir(parents=True)
    monkeypatch.setattr(extras, "__file__", str(tmp_path / "site" / "jaxfit" / "foundation/extras.py"))
    assert own_version() == "unknown"
    (tmp_path / "site" / "pyproject.toml").write_text('[project]\nname = "another"\nversion = "3"\n')
    assert own_version() == "unknown"


def test_doctor_names_the_other_software(installed):
    assert not list(doctor._other_software())
    installed["jaxfit"] = "0.1.0", extras._COMMAND  # an earlier version of this package
    assert other_jaxfit() is None
    installed["jaxfit"] = "0.0.5", None
    (finding,) = doctor._other_software()
    assert "0.0.5" in finding.state
    assert "other software" in finding.state
    assert "pip uninstall jaxfit" in finding.remedy
    assert doctor._other_software in doctor._CHECKS


def test_no_text_installs_the_other_software():
    """Documents, notebooks and messages say what works in a checkout."""
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    texts = [ROOT / name for name in names.split("\0") if name.endswith((".md", ".py", ".ipynb", ".toml", ".yaml"))]
    texts = [path for path in texts if path.name not in ("CHANGELOG.md", Path(__file__).name) and path.is_file()]
    wrong = re.compile(r"pip install(?: --?[\w-]+)* [\\\"']*jaxfit(?![\w-])")
    warned = re.compile(r"never (run )?`pip install jaxfit`")
    found = [path.name for path in texts if wrong.search(warned.sub("", path.read_text(encoding="utf-8")))]
    assert not found
    assert any(json.dumps('pip install ".[report]"')[1:-1] in path.read_text() for path in texts)
    for extra in {package.extra for package in extras.OPTIONAL_PACKAGES.values()}:
        assert extra in PROJECT["optional-dependencies"]
        assert f'".[{extra}]"' in install_command(extra)
