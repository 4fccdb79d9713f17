"""The section on behaviour shows every bout, its link to the film, gaps of curves and time budgets; names are text."""

import dataclasses
import itertools
import re
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from support import overlays
from support.exported import TRACKS, write_result

from jaxfit.behaviour.bouts import OTHER, Bout, Budget, Ethogram, time_budget
from jaxfit.behaviour.page import behaviour_of
from jaxfit.behaviour.registry import own_features
from jaxfit.behaviour.rules import load_behaviour_config
from jaxfit.data.solution import load_solution, save_solution
from jaxfit.view.report.behaviour import Behaviour, Kind, ShownBout, ShownBudget
from jaxfit.view.report.contents import gather
from jaxfit.view.report.curves import Curve, line_path, scale_of
from jaxfit.view.report.ethogram import ethogram_svg
from jaxfit.view.report.page import page
from jaxfit.view.report.write import film_address, report_of_result

NAME = '<b>bow</b> & "x"'
KINDS = (Kind(NAME, "It <i>bows</i>.", 0), Kind("standing", "It stands.", 1), Kind("other", "No rule holds.", None))
SVG = "{http://www.w3.org/2000/svg}"


def behaviour_in(track_id, frames, state, **changes):
    """Return a behaviour with the bouts of its states, at 10 frames a second."""
    state = np.asarray(state)
    times_s, bouts = np.asarray(frames) / 10, []
    for bird, row in enumerate(state):
        edges = [0, *(np.flatnonzero(np.diff(row)) + 1), len(row)]
        for a, b in itertools.pairwise(edges):
            if row[a] in (0, 1):
                bouts.append(ShownBout(bird, int(row[a]), slice(a, b), times_s[a], times_s[b - 1] + 0.1, 8))
    posed = (state >= 0).sum(1)
    with np.errstate(invalid="ignore"):
        budget = [ShownBudget(k, 1.0, 1, 0.4, 0.2, 0.7, (state == k).sum(1) / posed) for k in range(3)]
    made = Behaviour(np.asarray(track_id), np.asarray(frames), times_s, KINDS, state, bouts, (), budget, ())
    return made._replace(**changes)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("behaviour") / "exported"
    write_result(folder)
    return folder, load_solution(folder)[0]


@pytest.fixture
def report(result):
    folder, solution = result
    return gather(solution, None, {}, "", folder)


@pytest.fixture
def behaviour(report):
    """Three birds in frames 10, 12, 14, 18, 20: one bows and stands, one shows nothing, one has no pose."""
    state = [[0, 0, 1, 1, 1], [2, 2, -1, 2, 2], [-1] * 5]
    values = np.where(np.array(state) < 0, np.nan, np.linspace(0, 40, 5))
    curve = Curve("Body pitch", "°", values, "Pitch <of> the body.")
    return behaviour_in(TRACKS, report.frames, state, curves=(curve,), notes=("The vertical is <estimated>.",))


def section_of(text):
    return text.split("<h2>Behaviour</h2>")[1].split("<h2>Quality")[0]


def bouts_of(section):
    """Return the tooltip of each part of the rows with its address (None without a link), left end and width."""
    found = re.findall(r'<(?:a|span) class="bout [^"]*" style="left:([\d.]+)%;width:([\d.]+)%" title="([^"]*)"'
                       r'(?: href="([^"]*)")?', section)  # fmt: skip
    return [(title, href or None, float(left), float(width)) for left, width, title, href in found]


def test_bouts_have_tooltips_and_lead_to_the_film(report, behaviour):
    section = section_of(page(report, [], behaviour=behaviour, film="../a%20b.mp4"))
    ethogram, budget = section.split("<h3>Curves")[0], section.split("Each bird")[1]
    bow, stand, first, second = bouts_of(ethogram)
    assert bow[0].endswith(", 1.00 s to 1.30 s (0.30 s), frames 10 to 12, with track 8")
    assert bow[1:] == ("../a%20b.mp4#t=1.00", 0.0, 33.33)
    assert stand[1:] == ("../a%20b.mp4#t=1.40", 33.33, 66.67)
    # without a pose in frame 14 and without a frame 16, nothing is drawn
    assert first == ("track 7: other", None, 0.0, 33.33)
    assert second == ("track 7: other", None, 66.67, 33.33)
    for part in (ethogram, budget):
        assert re.findall(r"</i>(\d)</span><div class=\"bouts\">", part) == ["3", "7", "8"]
    assert [row[2:] for row in bouts_of(budget)] == [(0.0, 40.0), (40.0, 60.0), (0.0, 100.0)]
    assert "href" not in section_of(page(report, [], behaviour=behaviour)).replace('<use class="case" href="#', "")


def test_words_of_the_behaviour_are_text(report, behaviour):
    text = page(report, [], behaviour=behaviour)
    assert "<b>bow" not in text
    assert "<i>bows" not in text
    assert "The vertical is &lt;estimated&gt;." in section_of(text)
    words = text.split("What the words mean")[1]
    for word in ("Ethogram", "Bout", "Time budget", "It &lt;i&gt;bows&lt;/i&gt;.", "Pitch &lt;of&gt; the body."):
        assert word in words
    assert "script" not in text
    assert 'default-src &#x27;none&#x27;; style-src &#x27;unsafe-inline&#x27;; img-src data:"' in text


def test_pages_without_behaviour_have_no_section(report, behaviour, result):
    folder, solution = result
    assert "Behaviour" in page(report, [], behaviour=behaviour)
    without = dataclasses.replace(solution, valid=np.zeros_like(solution.valid))
    for other in (
        dataclasses.replace(report, photographs=5),
        gather(without, None, {}, "", folder),
        dataclasses.replace(report, frames=report.frames[:1]),
    ):
        assert "Behaviour" not in page(other, [], behaviour=behaviour)
    assert "Behaviour" not in page(report, [])
    with pytest.raises(ValueError, match="behaviour: expected the 3 birds and 5 frames"):
        page(report, [], behaviour=behaviour._replace(frames=behaviour.frames + 1))


def test_curves_have_gaps_ticks_and_a_line_for_each_bird(report, behaviour):
    plot = section_of(page(report, [], behaviour=behaviour)).split("Body pitch")[1].split("</svg>")[0]
    lines = dict(re.findall(r'id="curve0-(\d)" d="([^"]*)"', plot))
    # frame 16 is missing; the third bird has no value
    x = {n: [[int(point.split()[0]) for point in run.split("L")] for run in line[1:].replace("h0", "").split("M")]
         for n, line in lines.items()}  # fmt: skip
    assert x == {"0": [[0, 1, 2], [4, 5]], "1": [[0, 1], [4, 5]]}
    assert re.findall(r"<span style=\"bottom:([\d.]+)%\">([^<]*)", plot)[:2] == [("0.0", "0"), ("24.0", "10")]
    assert "track 3: median 20°, 90 % of the frames 2 to 38°" in plot
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
    values = np.arange(4000.0)[None]
    curve = Curve("Speed", "m/s", values, "d")
    made = behaviour_in([3], np.arange(4000), state, curves=(curve,))
    drawn = ElementTree.fromstring(ethogram_svg(made))
    short = next(rect for rect in drawn.iter(f"{SVG}g") if NAME in rect.findtext(f"{SVG}title", ""))
    assert float(short.find(f"{SVG}rect").get("width")) == pytest.approx(894 / 500, abs=0.01)
    assert "200.10 s" not in ethogram_svg(made)  # minutes
    assert "3:20.10 to 3:20.30 (0.20 s), frames 2,001 to 2,002" in short.findtext(f"{SVG}title")


def test_the_ethogram_is_a_drawing_of_its_own(behaviour):
    text = ethogram_svg(behaviour, "<film> & more", "../film.mp4")
    drawn = ElementTree.fromstring(text)
    assert drawn.tag == f"{SVG}svg"
    texts = [each.text for each in drawn.iter(f"{SVG}text")]
    for word in ("<film> & more", NAME, "standing", "other", "3", "7", "8", "10", "1.0 s", "frame"):
        assert word in texts
    assert "The vertical is <estimated>." in texts
    assert [each.get("href") for each in drawn.iter(f"{SVG}a")] == ["../film.mp4#t=1.00", "../film.mp4#t=1.40"]
    assert not list(ElementTree.fromstring(ethogram_svg(behaviour)).iter(f"{SVG}a"))


def test_films_have_addresses_that_are_no_script(tmp_path):
    film = tmp_path / "films" / "javascript:a #1?.mp4"
    film.parent.mkdir()
    assert film_address(film, tmp_path / "result" / "report.html") is None
    film.write_bytes(b"")
    address = "javascript%3Aa%20%231%3F.mp4"
    assert film_address(film, tmp_path / "result" / "report.html") == f"../films/{address}"
    assert film_address(film, film.parent / "report.html") == address
    assert film_address(film.parent, tmp_path / "report.html") is None  # a folder of pictures


def test_a_report_of_a_result_has_links_to_its_footage(tmp_path):
    video = overlays.film(tmp_path / "film.mp4")
    solution = overlays.solution()
    save_solution(solution, overlays.BIRD, "window: 3\n", {}, tmp_path / "result")
    state = np.where(solution.valid, 0, -1)
    made = behaviour_in(solution.track_id, solution.frame_index, state)
    path = report_of_result(tmp_path / "result", video, describe=lambda _: made)
    addresses = re.findall(r'href="([^"]*)#t=', Path(path).read_text(encoding="utf-8"))
    assert addresses == ["../film.mp4"] * len(made.bouts)


def test_descriptions_become_sections():
    """Names and colours come from the config, reasons for what is missing become sentences."""
    config = load_behaviour_config()
    features = [each for each in own_features() if each.name in ("body_pitch", "wing_spread")]
    values = {each.name: np.zeros((2, 3)) for each in features}
    solution = SimpleNamespace(track_id=np.array([4, 2]), frame_index=np.arange(3))
    flock = SimpleNamespace(solution=solution, unit="length", notes=("the vertical is estimated from 2 birds",))
    missing = {"speed": "the times are unknown", "neighbour_distance": "the result has one bird"}
    description = SimpleNamespace(flock=flock, features=features, values=values, missing=missing)
    bout = Bout(1, "take_off", slice(0, 2), 0.0, 0.2, None, {})
    state = np.array([[1, 1, 1], [0, 0, -1]])
    names = "take_off", OTHER
    ethogram = Ethogram(names, state, (bout,), np.arange(3) / 10, np.full(3, 0.1), {"bow": "the model has no bill"})
    budget = time_budget(ethogram, solution.track_id)
    assert isinstance(budget[0], Budget)
    made = behaviour_of(description, ethogram, budget, config)
    take_off = Kind("take off", config.behaviours["take_off"].definition, list(config.behaviours).index("take_off"))
    assert list(made.kinds) == [take_off, Kind("other", "The bird has a pose, and no rule holds.", None)]
    assert made.bouts == [ShownBout(1, 0, slice(0, 2), 0.0, 0.2, None)]
    assert [(row.share, row.of_birds.tolist()) for row in made.budget] == [
        (pytest.approx(0.4), [0.0, 1.0]),
        (pytest.approx(0.6), [1.0, 0.0]),
    ]
    assert [(curve.title, curve.unit) for curve in made.curves] == [
        ("Body pitch", "°"),
        ("Wing spread", "share of the wing span"),
    ]
    assert made.notes[1:] == [
        "The vertical is estimated from 2 birds.",
        "No curve of speed: the times are unknown.",
        "No curve of distance of the nearest neighbour: the result has one bird.",
        "The result cannot show bow: the model has no bill.",
    ]
