"""A saved page holds what the server sends, needs no network, says what it leaves out, and is written whole."""

import base64
import gzip
import json
import re

import pytest
from support.cli_files import rejected

from jaxfit.cli.main import main
from jaxfit.export.result import open_result
from jaxfit.foundation.errors import InputError
from jaxfit.viewer import saved
from jaxfit.viewer.saved import save_page
from jaxfit.viewer.shown import Shown


def opened(text):
    return gzip.decompress(base64.b64decode(text))


def elements(page):
    return dict(re.findall(r'<script type="text/plain" data-path="([^"]*)"[^>]*>([^<]*)</script>', page))


def test_one_file_holds_what_the_server_sends(result, tmp_path):
    seen, video = result
    done = save_page([seen], video, tmp_path / "page.html")
    text = done.path.read_text(encoding="utf-8")
    assert done.bytes == len(text.encode())
    held = elements(text)
    facts = json.loads(opened(held["facts"]))
    assert facts["film"]["source"] == "film"
    assert base64.b64decode(held["film"])[4:8] == b"ftyp"
    assert facts["corrections"] is None
    for path, content in {
        "results/0/rig": seen.rig(),
        "results/0/flags": seen.flags(),
        "results/0/poses/0": seen.part(0),
        "results/0/outlines/0": seen.outlines(0),
        "results/0/values/confidence": seen.values("confidence"),
    }.items():
        assert opened(held[path]) == content
    names = [value["name"] for value in facts["results"][0]["values"]]
    assert {f"results/0/values/{name}" for name in names} >= {path for path in held if "/values/" in path}
    own = re.sub(r"base64,[A-Za-z0-9+/=]*", "", text)
    assert not re.findall(r'(?:src|href)="(?!data:)', own)
    assert "default-src 'none'" in own
    assert "MIT License" in own
    assert any("corrections" in what for what in done.left_out)


def test_a_folder_holds_the_film_as_it_is(result, tmp_path):
    seen, video = result
    done = save_page([seen, seen], video, tmp_path / "page")
    assert done.path == tmp_path / "page" / "index.html"
    assert (tmp_path / "page" / "film.mp4").read_bytes() == video.read_bytes()
    call = (tmp_path / "page" / "data" / "results-1-poses-0.js").read_text()
    name, content = re.fullmatch(r'jaxfitSaved\("([^"]*)", "([^"]*)"\)\n', call).groups()
    assert (name, opened(content)) == ("results/1/poses/0", seen.part(0))
    facts = json.loads(opened(elements(done.path.read_text(encoding="utf-8"))["facts"]))
    assert len(facts["results"]) == 2


def test_the_film_covers_the_frames_of_all_results(result, tmp_path):
    seen, video = result
    count, first = len(seen.solution.frame_index), int(seen.solution.frame_index[0])
    later = Shown(seen.folder, open_result(seen.folder, None, (first + 2, None)))
    done = save_page([later, seen], video, tmp_path / "page.html")
    facts = json.loads(opened(elements(done.path.read_text(encoding="utf-8"))["facts"]))
    assert len(facts["film"]["times_s"]) == count


def test_curves_that_are_not_defined_are_not_offered(result, tmp_path):
    seen, _ = result
    alone = Shown(seen.folder, open_result(seen.folder, [seen.solution.track_id.tolist()[0]]))
    with pytest.raises(InputError):
        alone.values("neighbour_distance")
    done = save_page([alone], None, tmp_path / "page.html")
    held = elements(done.path.read_text(encoding="utf-8"))
    offered = [value["name"] for value in json.loads(opened(held["facts"]))["results"][0]["values"]]
    assert "neighbour_distance" not in offered
    assert {f"results/0/values/{name}" for name in offered} == {path for path in held if "/values/" in path}
    assert any("neighbour" in what for what in done.left_out), done.left_out


def test_a_page_that_is_too_large_loses_the_film_and_then_fails(result, tmp_path, monkeypatch):
    seen, video = result
    without = save_page([seen], None, tmp_path / "without.html").bytes
    monkeypatch.setattr(saved, "LARGEST_FILE", without + 100_000)
    widths = []

    def write_large(video, frames, out, width, progress):
        widths.append(width)
        out.write_bytes(bytes(200_000))
        return frames / 10

    monkeypatch.setattr(saved, "write_copy", write_large)
    full = seen.size_px[0]
    monkeypatch.setattr(saved, "WIDTHS", (full + 2, full + 1, full - 1, full - 2))
    done = save_page([seen], video, tmp_path / "page.html")
    assert widths == [full, full - 1, full - 2]
    assert any(what.startswith("the film") for what in done.left_out)
    facts = json.loads(opened(elements(done.path.read_text(encoding="utf-8"))["facts"]))
    assert facts["film"] is None
    assert "the film" in facts["notes"][0]
    monkeypatch.setattr(saved, "LARGEST_FILE", 1000)
    with pytest.raises(InputError, match="--frames A:B, or a folder"):
        save_page([seen], video, tmp_path / "other.html")
    assert not (tmp_path / "other.html").exists()


def test_earlier_pages_are_replaced_on_demand_only(result, tmp_path, capsys):
    seen, _ = result
    page, folder = tmp_path / "page.html", tmp_path / "folder"
    page.write_text("an earlier page")
    folder.mkdir()
    (folder / "index.html").write_text("an earlier page")
    for path in (page, folder):
        rejected(capsys, ["view", str(seen.folder), "--save", str(path)], path.name)
    assert main(["view", str(seen.folder), "--save", str(folder), "--overwrite"]) == 0
    assert "left out: corrections" in capsys.readouterr().out
    assert (folder / "data").is_dir()
    other = tmp_path / "other"
    other.mkdir()
    (other / "mine.txt").write_text("mine")
    rejected(capsys, ["view", str(seen.folder), "--save", str(other), "--overwrite"], "other")
    assert (other / "mine.txt").read_text() == "mine"
