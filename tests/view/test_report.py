"""The report holds the numbers of the result, stands alone, and shows names of files as text."""

import base64
import dataclasses
import itertools
import json
import re
import shutil
import subprocess
from types import SimpleNamespace
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from support import overlays
from support.birds import error_bars
from support.cli_files import rejected
from support.exported import BIRD, FRAMES, TRACKS, solution, write_result

from jaxfit.behaviour.bouts import OTHER, Bout, Budget, Ethogram, time_budget
from jaxfit.behaviour.page import BehaviourPage, Kind
from jaxfit.behaviour.registry import own_features
from jaxfit.behaviour.rules import load_behaviour_config
from jaxfit.cli.main import main
from jaxfit.data.formats.coco import read_coco
from jaxfit.data.solution import load_solution, save_solution
from jaxfit.foundation.errors import InputError
from jaxfit.model.bird import rest_length
from jaxfit.view.report.axis import clock, duration
from jaxfit.view.report.contents import gather, next_steps, warnings_of
from jaxfit.view.report.curves import line_path, scale_of
from jaxfit.view.report.page import Measured, page
from jaxfit.view.report.timeline import timeline_of
from jaxfit.view.report.write import film_address, report_of_result

FILM = "b<script>alert(1)</script>\n&.mp4"
BOW = '<b>bow</b> & "x"'
NAMES = (BOW, "standing", OTHER)
SVG = "{http://www.w3.org/2000/svg}"
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def parsed(text):
    """Return the page as elements; the page is also well-formed XML."""
    return ElementTree.fromstring(text.removeprefix("<!DOCTYPE html>\n"))


def section(root, title):
    titled = ((each, each.find("h2"), each.find("details/summary/h2")) for each in root.iter("section"))
    return next((each for each, *heads in titled if title in [head.text for head in heads if head is not None]), None)


def titles(element):
    """Return the explained words and their meanings."""
    return {text_of(each): each.get("title") for each in element.iter("abbr")}


def text_of(element):
    return " ".join("".join(element.itertext()).split())


def rows_of(element):
    """Return the texts of the cells of tables by the first cell of their row."""
    rows = [[text_of(cell) for cell in row] for row in element.iter("tr")]
    return {row[0]: row[1:] for row in rows}


def with_class(element, name):
    return [each for each in element.iter() if name in each.get("class", "").split()]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A result with detections, error bars and flags."""
    folder = tmp_path_factory.mktemp("report") / "exported"
    shape = len(TRACKS), len(FRAMES), BIRD.num_keypoints
    share = np.array([0.02, 0.03, 0.05, 0.1, 0.5])
    covariance = np.zeros((*shape, 3, 3), np.float32)
    covariance[0] = ((share * rest_length(BIRD) * solution().poses.scale[0]) ** 2 / 3)[:, None, None, None] * np.eye(3)
    doubts = np.zeros(shape[:2], np.int8)
    doubts[0] = [0, 0, 1, 8, 8]
    changes = {"loss": {"a": np.array([10.0, 2.0, np.nan]), "b": np.array([0.5, 2.0, np.nan])}, "doubts": doubts}
    bars = error_bars(solution(), keypoints_centred_cov=covariance)
    write_result(folder, with_detections=True, video=f"/films/{FILM}", **bars, **changes)
    summary = json.loads((folder / "summary.json").read_text())
    summary |= {
        "trust": "low",
        "trust_reasons": ["<img src=x onerror=alert(1)>"],
        "networks": {"<b>": {"<i>": "0" * 64}},
    }
    summary["video"]["damaged"] = [16]
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


@pytest.fixture(scope="module")
def made(folder):
    return load_solution(folder)[0]


@pytest.fixture(scope="module")
def report(folder, made):
    """The content of a report of the poses alone."""
    return gather(made, None, {}, "", folder)


@pytest.fixture(scope="module")
def root(folder, tmp_path_factory):
    """The page of the result."""
    return parsed(report_of_result(folder, out=tmp_path_factory.mktemp("page") / "page.html").read_text("utf-8"))


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """A result with its footage."""
    folder = tmp_path_factory.mktemp("drawn")
    video = overlays.film(folder / "film.mp4")
    save_solution(overlays.solution(), overlays.BIRD, "window: 3\n", {}, folder / "result")
    return folder / "result", video


def test_the_table_holds_the_numbers_of_the_result(root, made):
    rows = rows_of(section(root, "Quality of each track"))
    confidence = np.split(np.linspace(0.1, 1, made.keypoints.px[..., 0].size), 3)[0].mean()
    assert rows["3"][:4] == ["✓ ok", "10 to 20", "5", "2 / 2 / 1"]
    assert rows["3"][4:7] == ["5", "83", "1"]
    assert rows["3"][7] == f"{confidence:.2f}"
    assert rows["7"][:3] == ["▲ partly diverged", "10 to 20", "3"]
    assert rows["8"][:3] == ["✕ diverged", "10 to 20", "0"]
    assert [rows[track][-3] for track in "378"] == ["2.1", "1.3", "–"]
    assert rows["Track"][-2] == "Error bars% of length, 0 to 10 %"
    assert rows["3"][-2].startswith("5.0")  # the text of a cell also has the title of the curve
    assert rows["8"][-2] == "–"
    assert "8 poses53.3 % of the detections" in text_of(with_class(root, "cards")[0])
    assert "Tracks 7, 8: some or all frames have no pose" in text_of(section(root, "Warnings"))
    words = titles(root)
    assert "With detections of networks, error bars are too narrow" in words["Error bars"]
    assert all(words[word] for word in ("tracks", "poses", "trust", "Status", "Confidence", "Objective"))


def test_the_curve_of_error_bars_has_marks_at_flagged_frames(root):
    row = next(row for row in section(root, "Quality of each track").iter("tr") if text_of(row[0]) == "3")
    (svg,) = row[-2].iter("svg")
    curve = with_class(svg, "curve")[0].get("d")
    heights = [float(point.split()[1]) for point in curve[1:].split("L")]
    np.testing.assert_allclose(heights, 22 * (1 - np.array([0.2, 0.3, 0.5, 0.95, 0.95])), atol=0.06)
    assert with_class(svg, "s7")[0].get("d").startswith("M2 0h1v")
    assert with_class(svg, "s6")[0].get("d").startswith("M3 0h2v")


def test_the_page_stands_alone_and_shows_names_as_text(root):
    assert not {each.tag for each in root.iter()} & {"script", "link", "iframe", "object", "img", "b<"}
    assert FILM.replace("\n", " ") in text_of(root)
    assert "<img src=x onerror=alert(1)>" in text_of(root)
    policies = [each.get("content") for each in root.iter("meta") if each.get("http-equiv")]
    assert policies == ["default-src 'none'; style-src 'unsafe-inline'; img-src data:"]
    style = text_of(next(root.iter("style")))
    assert set(re.findall(r"var\((--[\w-]+)\)", style)) <= set(re.findall(r"(--[\w-]+):", style))


def test_pictures_show_the_footage_with_the_birds_and_bouts_lead_to_it(drawn):
    folder, video = drawn
    solution = overlays.solution()
    behaviour = behaviour_in(solution.track_id, solution.frame_index, np.where(solution.valid, 0, -1))
    root = parsed(report_of_result(folder, video, describe=lambda _: behaviour).read_text("utf-8"))
    images = list(root.iter("img"))
    assert [image.get("alt").split(" in ")[0] for image in images] == ["track 4", "track 11"]
    for n, image in enumerate(images):
        jpeg = base64.b64decode(image.get("src").removeprefix("data:image/jpeg;base64,"), validate=True)
        picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).astype(int)
        frames = [int(number) for number in image.get("alt").partition("frames ")[2].split(", ")]
        assert set(frames) <= set(solution.frame_index[solution.valid[n]].tolist())
        side = picture.shape[0]
        assert picture.shape == (side, 8 * side, 3)  # four moments
        for moment in range(4):
            film, view = (picture[:, (2 * moment + i) * side : (2 * moment + i + 1) * side] for i in (0, 1))
            assert (np.abs(film - overlays.GREY).max(-1) < 12).mean() > 0.3  # a bird on grey footage
            assert np.abs(film - overlays.GREY).max() > 60
            assert (view.min(-1) > 240).mean() > 0.3  # a bird on paper
            assert (view.min(-1) < 200).any()
    assert "Track 11" in text_of(section(root, "Birds"))
    addresses = [each.get("href") for each in root.iter("a")]
    assert [address.partition("#t=")[0] for address in addresses] == ["../film.mp4"] * len(behaviour.ethogram.bouts)


def states(shapes, columns):
    """Return the class of every column of a row; empty where nothing is drawn. Flags lie above it."""
    drawn = np.full(columns, "", object)
    for name, path in shapes:
        for start, width in re.findall(r"M(\d+) [\d.]+h(\d+)v", path) if name < "s6" else []:
            assert not any(drawn[int(start) : int(start) + int(width)])
            drawn[int(start) : int(start) + int(width)] = name
    return drawn.tolist()


def test_the_timeline_shows_poses_detections_and_confidences(folder, made, root, report):
    timeline = timeline_of(
        gather(made, read_coco(folder / "observations.json"), {"video": {"damaged": [16]}}, "", folder)
    )
    rows = {track.track_id: states(shapes, 6) for track, shapes in timeline.rows}
    # frame 16 is missing: six columns of two frames each
    assert rows == {
        3: ["s2", "s2", "s2", "", "s2", "s2"],
        7: ["s2", "s1", "s1", "", "s3", "s3"],
        8: ["s1", "s1", "s1", "", "s1", "s1"],
    }
    assert states(timeline.damaged, 6) == ["", "", "", "s1", "", ""]
    assert states(timeline_of(report).rows[1][1], 6) == ["s5", "", "", "", "s5", "s5"]
    shown = with_class(section(root, "Tracks over time"), "row")
    assert [text_of(with_class(row, "label")[0]) for row in shown] == ["frame", "birds ≤ 3", "3", "7", "8", "damaged"]
    drawn = [(path.get("class"), path.get("d")) for path in shown[3].iter("path")]
    assert drawn == timeline.rows[1][1]


def test_long_footage_has_several_frames_in_a_column(report):
    numbers = np.arange(2000)
    valid = numbers < 1001  # the last column of poses has one pose of four frames
    track = dataclasses.replace(
        report.tracks[0],
        valid=valid,
        present=valid,
        confidence=np.where(numbers < 600, 0.95, 0.6),
        size=np.ones(2000),
        flags=np.where(numbers == 402, "contradicted", "ok"),
        expected_error=np.full(2000, np.nan),
    )
    long = dataclasses.replace(report, frames=numbers, step=1, times_s=numbers / 25, tracks=(track,))
    ((_, shapes),) = timeline_of(long).rows
    assert states(shapes, 500) == ["s5"] * 150 + ["s3"] * 100 + [""] * 250
    assert dict(shapes)["s7"].startswith("M100 0.65h1v")  # the column of frame 402


def test_warnings_name_what_was_skipped(folder, made):
    def titles(doubts=None, **summary):
        fitted = made.with_arrays(status=np.full(3, "ok"), doubts=doubts)
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
    with pytest.raises(InputError, match=r"summary\.json: has an entry that jaxfit does not write"):
        titles(short_tracks=[3])


def test_poses_of_low_trust_are_not_recommended_for_statistics(folder, made):
    def commands(trust):
        steps = next_steps(gather(made, None, {"trust": trust}, "", folder))
        return " ".join(step.command or "" for step in steps)

    assert "jaxfit export" in commands("high")
    assert "jaxfit suggest" not in commands("high")
    assert "jaxfit export" not in commands("low")
    assert "jaxfit suggest" in commands("low")
    assert "--labels LABELS" in commands("low")


def test_a_result_of_labels_asks_for_further_labels(folder, made):
    summary = {"trust": "high", "pose_sources": {"3": {"labels": 3, "flow": 9, "outline": 0}}}
    texts = [step.text for step in next_steps(gather(made, None, summary, "", folder))]
    assert any("further frames" in text for text in texts)


def test_metrics_against_a_known_truth_are_tables(report):
    table = Measured(["track", "IoU <"], [("3", "0.9"), ("7", "0.8")], "IoU: overlap")
    shown = section(parsed(page(report, [], [table])), "Comparison with the truth")
    assert rows_of(shown) == {"track": ["IoU <"], "3": ["0.9"], "7": ["0.8"]}
    assert shown.findtext("details/p") == "IoU: overlap"
    assert section(parsed(page(report, [])), "Comparison with the truth") is None


def test_other_files_are_not_replaced_and_wrong_files_are_named(folder, drawn, tmp_path, capsys, caplog):
    here = shutil.copytree(folder, tmp_path / "exported")
    for _ in range(2):  # an earlier report is replaced
        assert main(["report", str(here)]) == 0
    assert "the footage is not there" in caplog.text
    out = tmp_path / "mine.html"
    out.write_text("mine")
    capsys.readouterr()
    rejected(capsys, ["report", str(here), "--out", str(out)], "mine.html: exists already", "--overwrite", alone=False)
    assert out.read_text() == "mine"
    assert main(["report", str(here), "--out", str(out), "--overwrite"]) == 0
    capsys.readouterr()
    rejected(capsys, ["report", str(here), "--video", str(tmp_path / "no.mp4")], "no.mp4: does not exist")
    rejected(capsys, ["report", str(tmp_path)], "poses.npz: does not exist")
    other = shutil.copytree(drawn[0], tmp_path / "other", ignore=shutil.ignore_patterns("report.html"))
    shutil.copy(here / "observations.json", other / "observations.json")
    rejected(capsys, ["report", str(other)], "observations.json: ")
    assert not (other / "report.html").exists()


@pytest.mark.extended
@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
@pytest.mark.parametrize("width", [500, 1280])
def test_a_browser_draws_the_page(drawn, tmp_path, width):
    solution, shot = overlays.solution(), tmp_path / "shot.png"
    rising = np.arange(overlays.T) * np.ones((2, 1))
    behaviour = behaviour_in(solution.track_id, solution.frame_index, 0 * rising.astype(int), body_pitch=rising)
    path = report_of_result(*drawn, out=tmp_path / "report.html", describe=lambda _: behaviour)
    path.write_text(path.read_text("utf-8").replace("<details>", "<details open>"), "utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},3600", f"--screenshot={shot}"]
    subprocess.run([BROWSER, *options, path.as_uri()], check=True, capture_output=True, timeout=120)
    image = cv2.imread(str(shot))
    assert image.shape[1] == width
    colours = image.reshape(-1, 3)
    bars = (colours == (0x6B, 0x30, 0x08)).all(1).sum()  # of the timeline: two birds
    assert bars > 2 * 0.5 * (width / 2) * 10
    footage = (np.abs(colours.astype(int) - overlays.GREY) < 3).all(1).sum()
    moments, tile_px = {500: (2, 118), 1280: (4, 138)}[width]  # that fit beside each other, of two birds
    assert footage > 0.3 * 2 * moments * tile_px**2
    assert (colours.max(-1) < 8).mean() < 0.002  # curves are lines, and not filled


def behaviour_in(track_id, frames, state, notes=(), **values):
    """Return a behaviour with the bouts of its states, at 10 frames a second; `values` are those of features."""
    state, track_id = np.asarray(state), np.asarray(track_id)
    times_s, bouts = np.asarray(frames) / 10, []
    for bird, row in enumerate(state):
        edges = [0, *(np.flatnonzero(np.diff(row)) + 1), len(row)]
        for a, b in itertools.pairwise(edges):
            if row[a] in (0, 1):
                bouts.append(Bout(bird, NAMES[row[a]], slice(a, b), times_s[a], times_s[b - 1] + 0.1, 8, {}))
    ethogram = Ethogram(NAMES, state, tuple(bouts), times_s, np.full(len(times_s), 0.1), {})
    posed = (state >= 0).sum(1)
    budget = [Budget(None, name, 1.0, 0.4, 1, 0.2, 0.7) for name in NAMES]
    for n in np.flatnonzero(posed):
        shares = [(state[n] == k).sum() / posed[n] for k in range(3)]
        budget += [Budget(track_id[n], name, 1.0, share, 1, 0, 0) for name, share in zip(NAMES, shares, strict=True)]
    rules = {BOW: SimpleNamespace(definition="It <i>bows</i>."), "standing": SimpleNamespace(definition="It stands.")}
    features = [
        SimpleNamespace(name=name, definition="Pitch <of> the body.", shown_unit=lambda unit: "°") for name in values
    ]
    solution = SimpleNamespace(track_id=track_id, frame_index=np.asarray(frames))
    flock = SimpleNamespace(solution=solution, unit="m")
    description = SimpleNamespace(flock=flock, features=features, values=values, missing={})
    return BehaviourPage(description, ethogram, budget, SimpleNamespace(behaviours=rules), notes)


@pytest.fixture(scope="module")
def behaviour(report):
    """Three birds in frames 10, 12, 14, 18, 20: one bows and stands, one shows nothing, one has no pose."""
    state = [[0, 0, 1, 1, 1], [2, 2, -1, 2, 2], [-1] * 5]
    values = np.where(np.array(state) < 0, np.nan, np.linspace(0, 40, 5))
    return behaviour_in(TRACKS, report.frames, state, notes=("The vertical is <estimated>.",), body_pitch=values)


@pytest.fixture(scope="module")
def behaving(report, behaviour):
    """The page of the birds with their behaviour."""
    return parsed(page(report, [], behaviour=behaviour, film="../a%20b.mp4"))


def test_bouts_have_tooltips_and_lead_to_the_film(behaving):
    ethogram, budget = (each for each in with_class(behaving, "timeline") if with_class(each, "bouts"))

    def bouts_of(element):
        bouts = with_class(element, "bout")
        places = [tuple(float(value) for value in re.findall(r"[\d.]+", bout.get("style"))) for bout in bouts]
        return [(bout.get("title"), bout.get("href"), *place) for bout, place in zip(bouts, places, strict=True)]

    bow, stand, first, second = bouts_of(ethogram)
    assert bow[0].endswith(", 1.00 s to 1.30 s (0.30 s), frames 10 to 12, with track 8")
    assert bow[1:] == ("../a%20b.mp4#t=1.00", 0.0, 33.33)
    assert stand[1:] == ("../a%20b.mp4#t=1.40", 33.33, 66.67)
    # without a pose in frame 14 and without a frame 16, nothing is drawn
    assert first == ("track 7: other", None, 0.0, 33.33)
    assert second == ("track 7: other", None, 66.67, 33.33)
    assert [text_of(row) for row in with_class(ethogram, "label")] == ["frame", "3", "7", "8"]
    assert [row[2:] for row in bouts_of(budget)] == [(0.0, 40.0), (40.0, 60.0), (0.0, 100.0)]


def test_words_of_the_behaviour_are_text(behaving):
    assert with_class(behaving, "notes")[0].findall("li")[1].text == "The vertical is <estimated>."
    words = titles(section(behaving, "Behaviour"))
    assert words[BOW] == "It <i>bows</i>."
    assert "Pitch <of> the body." in words.values()
    assert all(words[word] for word in ("Ethogram", "Bouts", "Time budget"))


def test_pages_without_behaviour_have_no_section(report, behaviour, folder, made):
    without = dataclasses.replace(made, valid=np.zeros_like(made.valid))
    for other in (
        dataclasses.replace(report, photographs=5),
        gather(without, None, {}, "", folder),
        dataclasses.replace(report, frames=report.frames[:1]),
    ):
        assert section(parsed(page(other, [], behaviour=behaviour)), "Behaviour") is None
    with pytest.raises(ValueError, match="behaviour: expected the 3 birds and 5 frames"):
        page(report, [], behaviour=behaviour_in(TRACKS, report.frames + 1, behaviour.ethogram.state))


def test_curves_have_gaps_ticks_and_a_line_for_each_bird(behaving):
    (plot,) = with_class(behaving, "plot")
    lines = {each.get("id"): each.get("d") for each in with_class(plot, "track")}
    # frame 16 is missing; the third bird has no value
    x = {name: [[int(point.split()[0]) for point in run.split("L")] for run in line[1:].split("M")]
         for name, line in lines.items()}  # fmt: skip
    assert x == {"curve0-0": [[0, 1, 2], [4, 5]], "curve0-1": [[0, 1], [4, 5]]}
    ticks = [(each.get("style"), each.text) for each in with_class(plot, "values")[0]]
    assert ticks[:2] == [("bottom:0.0%", "0"), ("bottom:24.0%", "10")]
    assert "track 3: median 20°, 90 % of the frames 2 to 38°" in [each.text for each in plot.iter("title")]
    assert line_path(np.array([np.nan, 5, np.nan]), scale_of(np.array([[0.0, 10.0]])))[-2:] == "h0"


def test_single_values_outside_the_axis_do_not_flatten_a_curve():
    values = np.linspace(0, 1, 1000)
    assert scale_of(values[None]).high == pytest.approx(1.04)
    values[500] = 1000
    assert scale_of(values[None]).high < 4
    equal = scale_of(np.full((1, 5), -3.0))
    assert equal.low < -3 < equal.high
    assert len(equal.ticks) > 1


def test_long_footage_has_at_most_500_columns_and_shows_short_behaviours():
    state = np.ones((1, 4000), int)
    state[0, 2001:2003] = 0
    drawn = ElementTree.fromstring(behaviour_in([3], np.arange(4000), state).svg())
    short = next(each for each in drawn.iter(f"{SVG}g") if BOW in each.findtext(f"{SVG}title", ""))
    assert float(short.find(f"{SVG}rect").get("width")) == pytest.approx(894 / 500, abs=0.01)
    assert "3:20.10 to 3:20.30 (0.20 s), frames 2,001 to 2,002" in short.findtext(f"{SVG}title")


def test_the_ethogram_is_a_drawing_of_its_own(behaviour):
    drawn = ElementTree.fromstring(behaviour.svg("<film> & more", "../film.mp4"))
    texts = [each.text for each in drawn.iter(f"{SVG}text")]
    for word in ("<film> & more", BOW, "standing", "other", "3", "7", "8", "10", "1.0 s", "frame"):
        assert word in texts
    assert "The vertical is <estimated>." in texts
    assert [each.get("href") for each in drawn.iter(f"{SVG}a")] == ["../film.mp4#t=1.00", "../film.mp4#t=1.40"]
    assert not list(ElementTree.fromstring(behaviour.svg()).iter(f"{SVG}a"))


def test_films_have_addresses_that_are_no_script(tmp_path):
    film = tmp_path / "films" / "javascript:a #1?.mp4"
    film.parent.mkdir()
    assert film_address(film, tmp_path / "result" / "report.html") is None
    film.write_bytes(b"")
    address = "javascript%3Aa%20%231%3F.mp4"
    assert film_address(film, tmp_path / "result" / "report.html") == f"../films/{address}"
    assert film_address(film, film.parent / "report.html") == address
    assert film_address(film.parent, tmp_path / "report.html") is None  # a folder of pictures


def test_descriptions_become_sections():
    """Names and colours come from the config, reasons for what is missing become sentences."""
    config = load_behaviour_config()
    features = [each for each in own_features() if each.name in ("body_pitch", "wing_spread")]
    values = {each.name: np.zeros((2, 3)) for each in features}
    solution = SimpleNamespace(track_id=np.array([4, 2]), frame_index=np.arange(3))
    flock = SimpleNamespace(solution=solution, unit="length")
    missing = {"speed": "the times are unknown", "neighbour_distance": "the result has one bird"}
    description = SimpleNamespace(flock=flock, features=features, values=values, missing=missing)
    bout = Bout(1, "take_off", slice(0, 2), 0.0, 0.2, None, {})
    state = np.array([[1, 1, 1], [0, 0, -1]])
    names = "take_off", OTHER
    ethogram = Ethogram(names, state, (bout,), np.arange(3) / 10, np.full(3, 0.1), {"bow": "the model has no bill"})
    budget, notes = time_budget(ethogram, solution.track_id), ("the vertical is estimated from 2 birds",)
    made = BehaviourPage(description, ethogram, budget, config, notes)
    take_off = Kind("take off", config.behaviours["take_off"].definition, list(config.behaviours).index("take_off"))
    assert made.kinds == [take_off, Kind("other", "The bird has a pose, and no rule holds.", None)]
    bars = with_class(ElementTree.fromstring(f"<div>{made.section([0, 1], None)}</div>"), "bouts")
    widths = [[re.search(r"width:([\d.]+)", bar.get("style"))[1] for bar in row] for row in bars]
    assert widths == [["100.00"], ["66.67"], ["100.00"], ["100.00"]]
    assert [(each.title, each.unit) for each in made.curves] == [
        ("Body pitch", "°"),
        ("Wing spread", "share of the wing span"),
    ]
    assert made.notes[1:] == [
        "The vertical is estimated from 2 birds.",
        "No curve of speed: the times are unknown.",
        "No curve of distance of the nearest neighbour: the result has one bird.",
        "The result cannot show bow: the model has no bill.",
    ]


def test_times_are_rounded_before_they_are_divided():
    assert [clock(frame / 240) for frame in (0, 14399, 28798, 863999)] == ["0.00 s", "1:00.00", "1:59.99", "1:00:00.00"]
    assert [duration(seconds) for seconds in (59.94, 59.96, 3599.4, 3599.6)] == [
        "59.9 s",
        "1:00 min",
        "59:59 min",
        "1:00:00 h",
    ]
    assert clock(59.96, digits=1) == "1:00.0"


def test_bodies_are_a_column_in_per_cent_of_the_model(folder):
    """The second body is not determined, and the third bird has none."""
    made, bird = load_solution(folder)
    bones, shapes, birds = bird.num_joints - 1, bird.num_shapes, len(made.track_id)
    assert birds == 3
    arrays = {"bone_length": np.ones((birds, bones)), "bone_length_sd": np.full((birds, bones), 0.01)}
    arrays |= {"betas": np.zeros((birds, shapes)), "betas_sd": np.zeros((birds, shapes))}
    arrays |= {"frames": np.array([5, 5, np.nan]), "determined": np.array([3.0, 0.5, np.nan])}
    arrays |= {"keypoint_scale": np.ones(birds), "outline_offset": np.zeros(birds)}
    arrays |= {"keypoint_offsets": np.zeros((birds, bird.num_keypoints, 3))}
    made = made.with_arrays(**{f"body_{name}": np.float32(values) for name, values in arrays.items()})
    root = parsed(page(gather(made, None, {}, "", folder, bird), []))
    table = rows_of(section(root, "Quality of each track"))
    names, headings = ("length", "head and bill"), next(iter(table.values()))
    assert headings[-1] == f"Body{' / '.join(names)}, % of the model"  # name and unit of the column
    cells = [table[str(track)][-1] for track in made.track_id.tolist()]
    assert re.fullmatch(r"100 ± \d / 100 ± \d", cells[0])
    assert cells[1:] == ["as the model", "–"]
    without = parsed(page(gather(load_solution(folder)[0], None, {}, "", folder, bird), []))
    assert "Body" not in text_of(section(without, "Quality of each track"))
