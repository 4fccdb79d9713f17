"""The report holds the numbers of the result, stands alone, and shows names of files as text."""

import base64
import dataclasses
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from support import overlays
from support.cli_files import rejected
from support.exported import BIRD, FRAMES, TRACKS, error_bars, write_result

from jaxfit.cli.main import main
from jaxfit.data.formats.coco import read_coco
from jaxfit.data.solution import load_solution, save_solution
from jaxfit.model.bird import rest_length
from jaxfit.view.report.contents import gather, next_steps, warnings_of
from jaxfit.view.report.page import Measured, page, spread_frames
from jaxfit.view.report.timeline import element, timeline

NAME = "b<script>alert(1)</script>\n&.mp4"
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


class Page(HTMLParser):
    """Reads a page; fails if an element is not closed."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.rows, self.text = [], [], [], ""
        self._open = []
        self.feed(text)
        assert not self._open

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.attributes += attributes
        if tag not in ("img", "meta"):
            self._open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.text += data
        if self.rows and {"td", "th"} & set(self._open):
            self.rows[-1][-1] += data


def summary_of(folder, **entries):
    path = folder / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | entries))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report") / "exported"
    loss = {"a": np.array([10.0, 2.0, np.nan]), "b": np.array([0.5, 2.0, np.nan])}
    write_result(folder, with_detections=True, video=f"/films/{NAME}", loss=loss)
    return folder


@pytest.fixture(scope="module")
def made(written):
    return load_solution(written)[0]


@pytest.fixture
def folder(written, tmp_path):
    return Path(shutil.copytree(written, tmp_path / "exported"))


@pytest.fixture
def drawn(tmp_path):
    """A result with its footage."""
    video = overlays.film(tmp_path / "film.mp4")
    save_solution(overlays.solution(), overlays.BIRD, "window: 3\n", {}, tmp_path / "result")
    return tmp_path / "result", video


def page_of(folder, *options):
    assert main(["report", str(folder), *options]) == 0
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def test_the_table_holds_the_numbers_of_the_result(folder, made, caplog):
    page = page_of(folder)
    assert "the footage is not there" in caplog.text
    rows = {row[0]: row[1:] for row in page.rows}
    confidence = np.split(np.linspace(0.1, 1, made.keypoints_px[..., 0].size), 3)[0].mean()
    assert rows["3"][:7] == ["✓ ok", "10 to 20", "5", "5", "83", "1", f"{confidence:.2f}"]
    assert rows["7"][:3] == ["▲ partly diverged", "10 to 20", "3"]
    assert rows["8"][:3] == ["✕ diverged", "10 to 20", "0"]
    assert [rows[track][-2] for track in "378"] == ["2.1", "1.3", "–"]
    assert "8 poses53.3 % of the detections" in page.text
    assert "Tracks 7, 8: some or all frames have no pose" in page.text


def test_the_table_shows_error_bars(written, folder, tmp_path):
    """The median expected error as a share of the length, and a curve with marks at flagged frames."""
    assert "Error bars" not in page_of(folder).text
    shape = len(TRACKS), len(FRAMES), BIRD.num_keypoints
    length = rest_length(BIRD) * load_solution(written)[0].scale[0]
    share = np.array([0.02, 0.03, 0.05, 0.1, 0.5])
    covariance = np.zeros((*shape, 3, 3), np.float32)
    covariance[0] = ((share * length) ** 2 / 3)[:, None, None, None] * np.eye(3)
    doubts = np.zeros(shape[:2], np.int8)
    doubts[0] = [0, 0, 1, 8, 8]
    write_result(tmp_path / "bars", **error_bars(shape, keypoints_centred_cov=covariance), doubts=doubts)
    page = page_of(tmp_path / "bars")
    rows = {row[0]: row[1:] for row in page.rows}
    assert rows["Track"][-2] == "Error bars% of length, 0 to 10 %"
    # the text of a cell also has the title of the curve
    assert rows["3"][-2].startswith("5.0")
    assert rows["8"][-2] == "–"  # no pose
    assert "With detections of networks, error bars are too narrow" in page.text
    row = (tmp_path / "bars" / "report.html").read_text().split("5.0<svg")[1].split("</svg>")[0]
    points = re.search(r'class="curve" d="M([^"]*)"', row)
    heights = [float(point.split()[1]) for point in points[1].split("L")]
    np.testing.assert_allclose(heights, 22 * (1 - np.array([0.2, 0.3, 0.5, 0.95, 0.95])), atol=0.06)
    assert re.search(r'class="s7" d="M2 0h1v', row)
    assert re.search(r'class="s6" d="M3 0h2v', row)


def test_the_page_stands_alone_and_shows_names_as_text(folder):
    summary_of(folder, trust="low", trust_reasons=["<img src=x onerror=alert(1)>"], networks={"<b>": {"<i>": "0" * 64}})
    page = page_of(folder)
    assert not set(page.tags) & {"script", "link", "iframe", "object", "img", "b<"}
    assert NAME.split("\n")[0] in page.text
    assert "<img src=x onerror=alert(1)>" in page.text
    for key, value in page.attributes:
        assert key not in ("onerror", "onload")
        assert "://" not in value
        if key == "href":  # a bout links to the film at its time, or a curve to itself
            assert re.fullmatch(r"[^:]*#(t=[\d.]+|[\w-]+)", value)
    assert ("http-equiv", "Content-Security-Policy") in page.attributes
    assert any(key == "content" and value.startswith("default-src 'none';") for key, value in page.attributes)


def test_text_of_an_attribute_is_escaped():
    assert element("td", 3, "<", None, title='"&') == '<td title="&quot;&amp;">3&lt;</td>'


def test_pictures_show_the_footage_with_the_birds(drawn):
    folder, video = drawn
    page = page_of(folder, "--video", str(video))
    images = [value for key, value in page.attributes if key == "src"]
    assert len(images) == overlays.T
    for image in images:
        jpeg = base64.b64decode(image.removeprefix("data:image/jpeg;base64,"), validate=True)
        picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape[1] == overlays.WIDTH
        assert np.abs(picture[: overlays.HEIGHT].astype(int) - overlays.GREY).max() > 60  # birds on grey footage
    assert "frame 5, 1 bird" in page.text
    assert "frame 4, 2 birds" in page.text


def test_frames_with_many_poses_are_chosen():
    valid = np.zeros((3, 100), bool)
    valid[0, 10:90] = True
    valid[1, [12, 40, 77]] = True
    valid[:, 41] = True
    assert spread_frames(valid, 4) == [12, 41, 59, 77]
    assert spread_frames(valid[:, 40:43], 4) == [0, 1, 2]
    assert spread_frames(np.zeros_like(valid), 4) == []


def states(svg, columns):
    """Return the class of every column of a row; empty where nothing is drawn. Flags lie above it."""
    drawn = np.full(columns, "", object)
    for name, path in re.findall(r'<path class="(s[1-5])" d="([^"]*)"', svg):
        for start, width in re.findall(r"M(\d+) [\d.]+h(\d+)v", path):
            assert not any(drawn[int(start) : int(start) + int(width)])
            drawn[int(start) : int(start) + int(width)] = name
    return drawn.tolist()


def bands(text):
    return {int(track): svg for track, svg in re.findall(r"<title>track (\d+)</title>(.*?)</svg>", text)}


def test_the_timeline_shows_poses_detections_and_confidences(folder, made):
    observations = read_coco(folder / "observations.json")
    report = gather(made, observations, {"video": {"damaged": [16]}}, "", folder)
    text = timeline(report)
    rows = bands(text)
    assert list(rows) == list(TRACKS)
    # frame 16 is missing: six columns of two frames each
    assert states(rows[3], 6) == ["s2", "s2", "s2", "", "s2", "s2"]
    assert states(rows[7], 6) == ["s2", "s1", "s1", "", "s3", "s3"]
    assert states(rows[8], 6) == ["s1", "s1", "s1", "", "s1", "s1"]
    assert states(text.split("damaged</span>")[1], 6) == ["", "", "", "s1", "", ""]
    without = bands(timeline(gather(made, None, {}, "", folder)))
    assert states(without[7], 6) == ["s5", "", "", "", "s5", "s5"]


def test_long_footage_has_several_frames_in_a_column(folder, made):
    report = gather(made, None, {}, "", folder)
    track = report.tracks[0]
    valid = np.zeros(2000, bool)
    valid[:1001] = True  # the last column of poses has one pose of four frames
    confidence = np.where(np.arange(2000) < 600, 0.95, 0.6)
    flagged = np.where(np.arange(2000) == 402, "contradicted", "ok")
    long = dataclasses.replace(
        track, valid=valid, present=valid, confidence=confidence, size=np.ones(2000), flags=flagged
    )
    numbers = np.arange(2000)
    report = dataclasses.replace(report, frames=numbers, step=1, times_s=numbers / 25, tracks=(long,))
    assert states(bands(timeline(report))[3], 500) == ["s5"] * 150 + ["s3"] * 100 + [""] * 250
    assert 'class="s7" d="M100 0.65h1v' in timeline(report)  # the column of frame 402


def test_warnings_name_what_was_skipped(folder, made):
    def titles(doubts=None, **summary):
        fitted = dataclasses.replace(made, status=np.full(3, "ok"), doubts=doubts)
        return [(each.title, each.text) for each in warnings_of(gather(fitted, None, summary, "", folder))]

    assert titles() == []
    ((title, text),) = titles(short_tracks={str(n): 2 for n in range(20)})
    assert title == "20 short tracks skipped"
    assert text.endswith("10 (2), 11 (2) and 8 more.")
    assert titles(low_score_tracks={"6": 0.6})[0][1].endswith("6 (0.60).")
    assert titles(failures={"7": ["frames 12 to 14: not finite"]})[0][0] == "1 problem of the fit"
    poses = int(made.valid.sum())
    ((title, _),) = titles(doubts=np.where(made.valid, 4, -1))
    assert title == f"Poses that may be wrong: {poses} unsure"
    assert titles(video={"damaged": [3, 4]})[0][1] == "2 frames of the video could not be decoded: 3, 4."


def test_poses_of_low_trust_are_not_recommended_for_statistics(folder, made):
    def commands(trust):
        steps = next_steps(gather(made, None, {"trust": trust}, "", folder))
        return " ".join(step.command or "" for step in steps)

    assert "jaxfit export" in commands("high")
    assert "jaxfit suggest" not in commands("high")
    assert "jaxfit export" not in commands("low")
    assert "jaxfit suggest" in commands("low")


def test_metrics_against_a_known_truth_are_tables(folder, made):
    report = gather(made, None, {}, "", folder)
    shown = Page(page(report, [], [Measured(["track", "IoU <"], [("3", "0.9"), ("7", "0.8")], "IoU: overlap")]))
    assert [row for row in shown.rows if row[:1] in (["track"], ["3"], ["7"])][-3:] == [
        ["track", "IoU <"],
        ["3", "0.9"],
        ["7", "0.8"],
    ]
    assert "Comparison with the truth" in shown.text
    assert "IoU: overlap" in shown.text
    assert "Comparison with the truth" not in page(report, [])


def test_other_files_are_not_replaced_and_wrong_files_are_named(folder, drawn, tmp_path, capsys):
    page_of(folder)
    page_of(folder)  # an earlier report is replaced
    out = tmp_path / "mine.html"
    out.write_text("mine")
    words = "mine.html: exists already", "--overwrite"
    rejected(capsys, ["report", str(folder), "--out", str(out)], *words, alone=False)
    assert out.read_text() == "mine"
    assert main(["report", str(folder), "--out", str(out), "--overwrite"]) == 0
    capsys.readouterr()
    rejected(capsys, ["report", str(folder), "--video", str(tmp_path / "no.mp4")], "no.mp4: does not exist")
    rejected(capsys, ["report", str(tmp_path)], "poses.npz: does not exist")
    summary_of(folder, short_tracks=[3])
    rejected(capsys, ["report", str(folder)], "summary.json: short_tracks must be an object", alone=False)
    other, _ = drawn
    shutil.copy(folder / "observations.json", other / "observations.json")
    rejected(capsys, ["report", str(other)], "observations.json: ")
    assert not (other / "report.html").exists()


@pytest.mark.extended
@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
@pytest.mark.parametrize("width", [500, 1280])
def test_a_browser_draws_the_page(drawn, tmp_path, width):
    folder, video = drawn
    page_of(folder, "--video", str(video))
    shot = tmp_path / "shot.png"
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},2600", f"--screenshot={shot}"]
    subprocess.run([BROWSER, *options, (folder / "report.html").as_uri()], check=True, capture_output=True, timeout=120)
    image = cv2.imread(str(shot))
    assert image.shape[1] == width
    colours = image.reshape(-1, 3)
    bars = (colours == (0x6B, 0x30, 0x08)).all(1).sum()  # of the timeline: two birds
    assert bars > 2 * 0.5 * (width / 2) * 10
    footage = (np.abs(colours.astype(int) - overlays.GREY) < 3).all(1).mean()
    assert footage > 0.05
