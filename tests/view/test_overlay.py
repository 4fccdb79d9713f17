"""The overlay shows the birds where they are, in the right order, and refuses a video that is not theirs."""

import contextlib
import dataclasses

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.birds import error_bars, filled_mask, pose_window
from support.overlays import BIRD, CAMERA, CROPS, FIRST, FPS, GREY, HEIGHT, WIDTH, N, T, film, solution

from jaxfit.data.observations import Observations
from jaxfit.data.projection import PosedBirds
from jaxfit.foundation.errors import InputError
from jaxfit.model.camera import project
from jaxfit.raster.zbuffer import hard_mask
from jaxfit.simulation.flock import smooth_motion
from jaxfit.video.reader import probe_video, read_frames
from jaxfit.view.birds import DrawnBird, Style, draw_birds, draw_regions, regions_95
from jaxfit.view.colours import DETECTED, FITTED, TRACK_COLOURS, track_colour
from jaxfit.view.contact_sheet import TILE_PX, contact_sheet
from jaxfit.view.legend import FLAGGED, REGION, Legend
from jaxfit.view.mesh_views import SideViews, up_direction
from jaxfit.view.overlay import CHUNK, overlay, overlay_frame


def detections(size=(WIDTH, HEIGHT)) -> Observations:
    """The first bird's bill tip, 20 px left of the fitted one."""
    points = np.zeros((1, T, BIRD.num_keypoints, 2))
    points[:, :, 0] = solution().keypoints.px[:1, :, 0] - [20, 0]
    confidence = np.zeros((1, T, BIRD.num_keypoints))
    confidence[:, :, 0] = 1
    return Observations(
        track_id=np.array([4]),
        frame_index=np.arange(FIRST, FIRST + T),
        present=np.ones((1, T), bool),
        keypoints_px=points,
        confidence=confidence,
        box_px=np.ones((1, T, 4)),
        image_size_px=np.full((T, 2), size),
        file_name=np.array([""] * T),
        keypoint_names=BIRD.keypoint_names,
    )


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """An overlay with everything, its frames, and the folder it lies in."""
    folder = tmp_path_factory.mktemp("overlay")
    film(folder / "film.mp4")
    ticks = []

    def progress(name, total):
        return contextlib.nullcontext(lambda done, note: ticks.append((done, total, note)))

    made = overlay(
        solution(),
        BIRD,
        folder / "film.mp4",
        folder / "out" / "o.mp4",
        observations=detections(),
        side_views=True,
        progress=progress,
    )
    return made, [frame.picture.astype(int) for frame in read_frames(made.video)], ticks


def masks(t):
    """Where each bird is in the picture, by the renderer; None where it is away."""
    posed = PosedBirds(solution(), BIRD)
    shape = WIDTH, HEIGHT
    return [
        hard_mask(posed.vertices_screen(n, t), posed.faces, *shape) if solution().valid[n, t] else None for n in (0, 1)
    ]


def changed(frame):
    return np.abs(frame[:HEIGHT] - GREY).sum(-1) > 24


def test_the_video_is_what_it_says(drawn):
    made, frames, ticks = drawn
    info = probe_video(made.video)
    assert (info.frames, info.fps, info.size_px) == (T, FPS, made.size_px)
    assert (made.frames, made.fps, made.fallback) == (T, FPS, False)
    assert len(frames) == T
    assert made.size_px[0] == WIDTH
    assert made.size_px[1] > HEIGHT + 100  # the legend and a strip
    assert [(done, total) for done, total, _ in ticks] == [(1, T)] * T
    assert ticks[0][2] == f"frame {FIRST}"
    assert sorted(p.name for p in made.video.parent.iterdir()) == ["o.mp4", "o.png"]


def test_birds_are_drawn_where_they_are_and_nowhere_else(drawn):
    for t, frame in enumerate(drawn[1]):
        differs, far = changed(frame), np.ones((HEIGHT, WIDTH), bool)
        for n, mask in enumerate(masks(t)):
            x0, y0, size = CROPS[n]
            if mask is None:
                assert differs[y0 : y0 + size, x0 : x0 + size].sum() == 0
                continue
            assert differs[mask].mean() > 0.95
            near = cv2.dilate(mask.astype(np.uint8), np.ones((9, 9))) > 0
            points = solution().keypoints.px[n, t]
            low, high = (points.min(0) - 70).astype(int), (points.max(0) + 70).astype(int)  # its number, its rings
            far[max(low[1], 0) : high[1], max(low[0], 0) : high[0]] = False
            edge = near & ~(cv2.erode(mask.astype(np.uint8), np.ones((5, 5))) > 0)
            towards = np.array(TRACK_COLOURS[n]) - GREY
            like = ((frame[:HEIGHT][edge] - GREY) @ towards) / np.linalg.norm(towards)
            assert np.percentile(like, 90) > 30  # an outline in the track's colour
        assert not differs[far].any()


def test_detected_keypoints_are_rings(drawn):
    made, frames, _ = drawn
    plain = overlay(solution(), BIRD, made.video.parents[1] / "film.mp4", made.video.parent / "plain.mp4")
    assert plain.size_px[1] < made.size_px[1]
    for t, frame, _ in read_frames(plain.video):
        x, y = np.round(detections().keypoints_px[0, t, 0]).astype(int)
        box = slice(y - 6, y + 6), slice(x - 6, x + 6)
        assert np.abs(frames[t][box] - frame[box]).sum(-1).max() > 60
    for file in (plain.video, plain.sheet):
        file.unlink()


def test_side_views_keep_their_places(drawn):
    side = SideViews(solution(), BIRD, WIDTH, Style.suited(WIDTH, 60).text_px)
    assert drawn[0].size_px[1] - side.height > HEIGHT
    strips = np.array(drawn[1])[:, -side.height :]
    tiles = [strips[:, 30 : side.tile_px - 3, n * side.tile_px + 3 : (n + 1) * side.tile_px - 3] for n in range(N)]
    ink = [(tile.min(-1) < 150).sum((1, 2)) for tile in tiles]
    assert (ink[0] > 300).all()
    assert (np.delete(ink[1], 2) > 300).all()
    assert ink[1][2] < 30  # away in the third frame


def test_the_contact_sheet_has_a_row_a_bird(drawn):
    sheet = cv2.imread(str(drawn[0].sheet)).astype(int)
    legend, sheet = sheet[: -N * TILE_PX], sheet[-N * TILE_PX :]
    assert sheet.shape == (N * TILE_PX, 4 * 2 * TILE_PX, 3)
    for colour in (FITTED, DETECTED, track_colour(0)):  # dots, rings and outlines are explained
        assert (np.abs(legend - colour).sum(-1) < 40).any()
    tiles = sheet.reshape(N, TILE_PX, 8, TILE_PX, 3).transpose(0, 2, 1, 3, 4)
    for n in range(N):
        for pair in range(4):
            footage, mesh = tiles[n, 2 * pair], tiles[n, 2 * pair + 1]
            # crops that reach beyond the picture are black there
            assert (np.abs(footage - GREY).sum(-1) < 30).mean() > 0.3
            assert 0.03 < (np.abs(mesh - mesh[0, 0]).sum(-1) > 40).mean() < 0.6


@pytest.mark.parametrize("one_camera", [True, False])
def test_which_bird_hides_the_other(one_camera):
    """One is nearer, the other lower in the picture: depth counts only where it can be compared."""
    square = np.array([[0, 0], [60, 0], [60, 60], [0, 60]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]])

    def card(n, place, depth):
        screen = np.column_stack([square + place, np.full(4, depth)]).astype(np.float32)
        colours = np.tile(np.eye(3, dtype=np.float32)[n], (4, 1))
        return DrawnBird(n, str(n), screen, colours, square + place, np.zeros((0, 2)))

    near_but_higher, far_but_lower = card(0, [20, 20], 100.0), card(1, [40, 50], 200.0)
    for birds in ([near_but_higher, far_but_lower], [far_but_lower, near_but_higher]):
        image = np.zeros((160, 160, 3), np.uint8)
        draw_birds(image, birds, faces, Style(1, 2, opacity=1.0), one_camera)
        assert image[65, 60].argmax() == (0 if one_camera else 1)
        assert image[30, 30].tolist() == [255, 0, 0]
        assert image[100, 90].tolist() == [0, 255, 0]
        assert (image[130:] == 0).all()


def marked(points, regions, size=400):
    """Where the regions of these keypoints change a grey picture."""
    image, points = np.full((size, size, 3), GREY, np.uint8), np.array(points, float)
    bird = DrawnBird(0, "1", np.zeros((3, 3)), np.zeros((3, 3)), points, np.zeros((0, 2)), regions)
    draw_regions(image, bird, Style(1, 2))
    return (image != GREY).any(-1)


def test_regions_contain_95_per_cent():
    """The line is where the Mahalanobis distance is √5.991, and the enclosed area is π·5.991·√det C."""
    point, covariance = np.array([[200.0, 180.0]]), np.array([[[900.0, 350.0], [350.0, 400.0]]])
    drawn = marked(point, regions_95(point, covariance, 500))
    y, x = np.mgrid[:400, :400] + 0.5
    offset = np.stack([x, y], axis=-1) - point[0]
    distance = np.sqrt(np.einsum("yxi,ij,yxj->yx", offset, np.linalg.inv(covariance[0]), offset) / 5.991)
    assert np.abs(distance[drawn] - 1).max() < 0.08
    angles = np.linspace(0, 2 * np.pi, 90)
    around = (
        point + np.sqrt(5.991) * np.column_stack([np.cos(angles), np.sin(angles)]) @ np.linalg.cholesky(covariance[0]).T
    )
    assert drawn[tuple(np.floor(around).astype(int).T[::-1])].all()
    inside = cv2.connectedComponents((~drawn).astype(np.uint8), connectivity=4)[1]
    area = (inside == inside[180, 200]).sum() + drawn.sum() / 2
    assert area == pytest.approx(np.pi * 5.991 * np.sqrt(np.linalg.det(covariance[0])), rel=0.01)


def test_regions_without_a_size():
    """NaN, zero and small covariances draw nothing; a region beyond all bounds has the largest size."""
    points = np.full((5, 2), 200.0)
    covariance = np.where(np.eye(2) > 0, np.array([np.nan, np.inf, 0, 1, 1e12])[:, None, None], 0)
    regions = regions_95(points, covariance, 100)
    assert not marked(points[:4], regions[:4]).any()
    rows, columns = np.nonzero(marked(points, regions))
    assert [rows.min(), rows.max(), columns.min(), columns.max()] == pytest.approx([99, 301, 99, 301], abs=2)
    line = regions_95(points[:1], np.diag([400.0, -1e-9])[None], 100)  # rounding may give negative variances
    rows, columns = np.nonzero(marked(points[:1], line))
    assert np.ptp(rows) <= 4
    assert np.ptp(columns) == pytest.approx(2 * np.sqrt(5.991) * 20, abs=6)
    assert not marked(points[:1], None).any()


def test_a_frame_shows_regions_and_flags(tmp_path):
    """The largest region is that of the covariance in pixels of the footage, also in a smaller picture."""
    video, shape = film(tmp_path / "f.mp4"), (N, T, BIRD.num_keypoints)
    covariance = np.zeros((*shape, 2, 2), np.float32)
    covariance[0, :, 0] = np.diag([400, 25])
    plain = solution().with_arrays(**error_bars(solution()))
    doubts = np.where(np.arange(N)[:, None] == 1, 4, np.zeros((N, T), np.int8)).astype(np.int8)
    changes = {
        "none": solution(),
        "plain": plain,
        "wide": plain.with_arrays(keypoints_px_cov=covariance),
        "flag": solution().with_arrays(doubts=doubts),
    }
    images = {}
    for name, made in changes.items():
        overlay_frame(made, BIRD, video, FIRST + 1, tmp_path / f"{name}.png", max_width=160)
        images[name] = cv2.imread(str(tmp_path / f"{name}.png"))[: HEIGHT // 2].astype(int)
    assert (images["none"] == images["plain"]).all()  # dots hide regions without an extent
    rows, columns = np.nonzero(np.abs(images["wide"] - images["plain"]).sum(-1) > 60)
    x, y = solution().keypoints.px[0, 1, 0] / 2
    half = np.sqrt(5.991) * 10  # half the size of the footage
    assert columns.min() == pytest.approx(max(x - half, 0), abs=3)
    assert columns.max() == pytest.approx(x + half, abs=3)
    assert [rows.min(), rows.max()] == pytest.approx([y - half / 4, y + half / 4], abs=3)
    differs = np.abs(images["flag"] - images["none"]).sum(-1) > 60
    assert differs.sum() > 100
    assert np.nonzero(differs)[1].min() > CROPS[0][0] / 2 + 30  # the second bird only


def test_the_legend_explains_regions_and_flags(monkeypatch):
    words = []
    monkeypatch.setattr("jaxfit.view.legend.text", lambda image, text, *more: words.append(text))
    Legend(900, Style(1, 2), detected=False, side_views=False)
    assert words == ["track", "fitted bird", "fitted keypoint"]
    Legend(900, Style(1, 2), detected=False, side_views=False, regions=True, flagged=True)
    assert words[6:] == [REGION, FLAGGED]
    assert "95 % region" in REGION
    assert "contradicted" in FLAGGED


@pytest.mark.parametrize("on_footage", [True, False])
def test_the_contact_sheet_shows_flags(tmp_path, monkeypatch, on_footage):
    words = []
    for module in ("contact_sheet", "legend"):
        monkeypatch.setattr(f"jaxfit.view.{module}.text", lambda image, text, *more: words.append(text))
    monkeypatch.setattr("jaxfit.view.contact_sheet.tag", lambda image, text, *more: words.append(text))
    doubts = np.array([[0, 1, 0, 0, 0, 4], [0, 0, -1, 0, 0, 0]], np.int8)
    tile = np.zeros((TILE_PX, TILE_PX, 3), np.uint8)
    footage = {(n, t): tile for n in range(N) for t in range(T)} if on_footage else None
    made = solution().with_arrays(doubts=doubts)
    contact_sheet(made, BIRD, None, tmp_path / "sheet.png", columns=T, footage=footage)
    assert f"track 4  frame {FIRST + 1} contradicted" in words
    assert f"track 4  frame {FIRST + 5} unsure" in words
    assert f"track 4  frame {FIRST}" in words
    assert f"track 11  frame {FIRST + 5}" in words
    assert FLAGGED in words


def test_only_every_second_frame_and_a_small_picture(tmp_path):
    made = overlay(
        solution(frame_index=tuple(range(0, 2 * T, 2))),
        BIRD,
        film(tmp_path / "f.mp4", 2 * T),
        tmp_path / "o.mp4",
        max_width=160,
    )
    assert (made.frames, made.fps, made.size_px[0]) == (T, FPS / 2, 160)
    for _, frame, _ in read_frames(made.video):
        assert np.abs(frame[: HEIGHT // 2].astype(int) - GREY).max() > 60


def test_vertices_of_a_window_are_those_of_its_frames():
    posed = PosedBirds(solution(), BIRD)
    for n in range(N):
        whole = posed.vertices_screen_window(n)
        vertices = pose_window(BIRD, smooth_motion(BIRD, T, n))[1]
        x0, y0, size = CROPS[n]
        by_hand = [*np.moveaxis(np.asarray(project(vertices, CAMERA)) * size / 256 + [x0, y0], -1, 0), vertices[..., 2]]
        np.testing.assert_allclose(whole, np.stack(by_hand, axis=-1), rtol=1e-5, atol=2e-3)
        np.testing.assert_allclose(posed.vertices_screen(n, 1), whole[1], rtol=1e-6, atol=1e-4)
        np.testing.assert_array_equal(posed.vertices_screen_window(n, slice(2, 4)).shape, (2, *whole.shape[1:]))
        filled = filled_mask(whole[0, :, :2], BIRD.faces, WIDTH)[:HEIGHT]
        assert (filled != masks(0)[n]).sum() <= 3  # pixels whose centre lies on an edge


def test_long_results_are_posed_chunk_by_chunk(tmp_path):
    """Longer than a chunk and no multiple of it: every frame still shows its own pose."""
    frames, still = CHUNK + 5, solution()
    names = ("valid", "global_orient", "body_pose", "transl", "scale", "bone_length", "betas", "image_size_px")
    names += ("keypoints_cam", "keypoints_px", "ambiguity_deg", "doubts")
    many = {name: np.repeat(still.arrays()[name][:1, :1], frames, 1) for name in names}
    crop = np.repeat(still.crops.square_px[:1, :1], frames, 1).copy()
    crop[:, :, 0] += np.arange(frames)  # it walks to the right, a pixel a frame
    many["keypoints_px"] = many["keypoints_px"] + (crop - still.crops.square_px[:1, :1])[:, :, None, :2]
    long = still.with_arrays(
        **many, crop=crop, track_id=[4], frame_index=np.arange(frames), status=["ok"], timestamp_s=None
    )
    made = overlay(long, BIRD, film(tmp_path / "f.mp4", frames), tmp_path / "o.mp4")
    middles = [np.flatnonzero(changed(frame.astype(int)).sum(0) > 3).mean() for _, frame, _ in read_frames(made.video)]
    np.testing.assert_allclose(np.diff(middles), 1, atol=6)  # the number may change sides
    assert middles[-1] - middles[0] == pytest.approx(frames - 1, abs=6)


def test_up_is_where_birds_stand():
    """Birds that face all ways, in a camera that looks down steeply: their feet tell where up is."""
    look = Rotation.from_euler("x", 130, degrees=True)
    headings = Rotation.from_rotvec(np.linspace(0, 300, T)[:, None] * [0, 0, 1], degrees=True)
    points = np.stack([look.apply(headings[t].apply(np.asarray(BIRD.keypoints))) for t in range(T)])
    standing = solution().with_arrays(keypoints_cam=np.stack([points, points + 5]))
    assert np.degrees(np.arccos(up_direction(standing) @ look.apply([0, 0, 1]))) < 3


def test_a_video_that_is_not_the_results(tmp_path):
    def refused(*words, video=None, **given):
        with pytest.raises(InputError) as error:
            overlay(
                given.pop("result", solution()), BIRD, video or film(tmp_path / "f.mp4"), tmp_path / "o.mp4", **given
            )
        for word in words:
            assert word in str(error.value)
        assert not list(tmp_path.glob("o.*"))
        assert not list(tmp_path.glob(".o*"))

    last = str(FIRST + T - 1)
    refused("short.webm", f"has {T} frames", last, video=film(tmp_path / "short.webm", T))  # learnt only at the end
    small = film(tmp_path / "small.mp4", size=(100, 60))
    refused("small.mp4: is not the video of the result", "100×60 instead of 320×200", "give the video", video=small)
    refused("observations", "640×400", "320×200", observations=detections((640, 400)))
    refused("hold no bird of the result", observations=dataclasses.replace(detections(), track_id=np.array([5])))
    refused("nothing.mp4", "does not exist", video=tmp_path / "nothing.mp4")
    (tmp_path / "text.mp4").write_text("no video")
    refused("text.mp4", "not a readable video", video=tmp_path / "text.mp4")
    empty = dataclasses.replace(solution(), valid=np.zeros((N, T), bool))
    refused("no valid pose", result=empty)
    sizes = solution().crops.image_size_px.copy()
    sizes[0, 1] = 100, 60
    several = solution().with_arrays(image_size_px=sizes)
    refused("holds images of several sizes (100×60 and 320×200), which no video has", result=several)
    refused("holds images of several sizes", result=several, force=True)
    other = dataclasses.replace(detections(), keypoint_names=("horn", *BIRD.keypoint_names[1:]))
    refused("horn", observations=other)
    with pytest.raises(ValueError, match="max_width"):
        overlay(solution(), BIRD, small, tmp_path / "o.mp4", max_width=3)
