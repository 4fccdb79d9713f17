"""`overlay`: a result on its video; checks that a video belongs to a result."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxfit.cameras.camera import Camera
from jaxfit.data.flags import CONTRADICTED, UNSURE, flags, with_flag
from jaxfit.data.footage import FootageIdentity, read_footage
from jaxfit.data.observations import Observations
from jaxfit.data.projection import PosedBirds
from jaxfit.data.solution import Solution
from jaxfit.data.tracks import frame_step
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import check_new_file, write_whole
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.foundation.threads import in_threads, usable_cores
from jaxfit.model.anatomy import skeleton_pairs
from jaxfit.model.bird import Bird
from jaxfit.raster.zbuffer import shade
from jaxfit.video.reader import VideoInfo, probe_video, read_frames
from jaxfit.video.writer import SLOWEST_FPS, VideoWriter
from jaxfit.view.birds import (
    Detected,
    DrawnBird,
    Number,
    Numbers,
    Style,
    draw_birds,
    draw_keypoints,
    draw_regions,
    regions_95,
)
from jaxfit.view.colours import tinted
from jaxfit.view.contact_sheet import contact_sheet, cut_tiles, sheet_pairs
from jaxfit.view.legend import Legend
from jaxfit.view.mesh_views import SideViews

_REMEDY = "give the video that the result was fitted to, or draw on this video all the same by --force"


def check_belongs(
    solution: Solution, observations: Observations | None, video: Path, info: VideoInfo, force: bool = False
) -> None:
    """Raise InputError where the result, the video and the observations do not belong together.

    Args:
        solution: the result.
        observations: the observations to draw.
        video: the video to draw on.
        info: its properties.
        force: accept another video than the video of the result, and observations of other image sizes.
    """
    if not solution.valid.any():
        raise InputError("result", "holds no valid pose, so there is nothing to draw", "see the status of each track")
    sizes = np.unique(solution.crops.image_size_px[solution.valid], axis=0).tolist()
    if len(sizes) > 1:
        shown = " and ".join(f"{width}×{height}" for width, height in sizes[:2])
        remedy = "`jaxfit report` without a video shows its birds; jaxfit.contact_sheet draws each in its image"
        raise InputError("result", f"holds images of several sizes ({shown}), which no video has", remedy)
    differences = [] if force else _differences(solution, video, info)
    if differences:
        cameras = "give the video of the first camera, or name that of this video (--camera of overlay and view); "
        remedy = _REMEDY if solution.world is None else cameras + "--force draws all the same"
        raise InputError(video, f"is not the video of the result: it has {', '.join(differences)}", remedy)
    if observations is None:
        return
    remedy = "give the file that the result was fitted to"
    if not (
        np.isin(solution.track_id, observations.track_id).any()
        and np.isin(solution.frame_index, observations.frame_index).any()
    ):
        problem = "hold no bird of the result: they share no track id or no frame number"
        raise InputError("observations", problem, remedy)
    seen = tuple(int(side) for side in observations.image_size_px[0])
    if seen != info.size_px and not force:
        width, height = info.size_px
        problem = f"are of {seen[0]}×{seen[1]} images, but the video is {width}×{height}"
        raise InputError("observations", problem, remedy)


def _differences(solution: Solution, video: Path, info: VideoInfo) -> list[str]:
    """Return how a video differs from the video of the result, as far as both are known."""
    known, texts = solution.footage or FootageIdentity(), []
    sizes = solution.crops.image_size_px[solution.valid]
    other = sizes[(sizes != info.size_px).any(1)]
    if len(other):
        texts.append(f"images of {info.size_px[0]}×{info.size_px[1]} instead of {other[0, 0]}×{other[0, 1]} pixels")
    if None not in (info.frames, known.frames) and info.frames != known.frames:
        texts.append(f"{info.frames} frames instead of {known.frames}")
    elif info.frames is not None and int(solution.frame_index[-1]) >= info.frames:
        texts.append(_too_few(solution, info.frames))
    if known.first_frame is not None and known.differs(read_footage(video, info.frames)):
        texts.append("another first frame")
    return texts


def check_outputs(outputs: list[Path], video: Path, overwrite: bool) -> None:
    """Raise InputError where an output file would replace the footage, or another file without `overwrite`.

    Args:
        outputs: the files to write.
        video: the footage, a file or a folder of images; outputs must not replace it or lie in the folder.
        overwrite: whether other files may be replaced.
    """
    for out in outputs:
        if out.exists() and out.samefile(video):
            raise InputError(out, "is the video itself, which would be lost", "choose another --out")
        if video.is_dir() and is_inside(out, video):
            raise InputError(out, f"lies among the video's images in {video}", "choose an --out elsewhere")
        check_new_file(out, overwrite)


def is_inside(path: Path, folder: Path) -> bool:
    """Whether a path lies in a folder, also through symbolic links; a cyclic link lies nowhere."""
    # `Path.resolve` raises an error for cyclic links
    return Path(os.path.realpath(folder)) in Path(os.path.realpath(path)).parents


def too_short(video: Path, solution: Solution, frames: int) -> InputError:
    """Return the error about a video with fewer frames than the result."""
    return InputError(video, f"has {_too_few(solution, frames)}", _REMEDY)


def _too_few(solution: Solution, frames: int) -> str:
    first, last = int(solution.frame_index[0]), int(solution.frame_index[-1])
    return f"{frames} frames, but the result has frames {first} to {last}, counted from 0"


CHUNK = 32  # frames posed in one call, so that the memory does not depend on the length of the video
FOLDER_FPS = 25.0
"""Frame rate of the overlay of a folder of images, which has no frame rate of its own."""


class Overlay(NamedTuple):
    """The files of an overlay and their properties."""

    video: Path
    sheet: Path
    """Contact sheet, PNG."""
    frames: int
    size_px: tuple[int, int]
    """Width and height of the video, as written."""
    fps: float
    codec: str
    """Name of `jaxfit.video.CODECS`."""
    fallback: bool
    """Whether the codec differs from the requested codec; a warning reports this."""


def overlay(
    solution: Solution,
    bird: Bird,
    video: str | Path,
    out: str | Path,
    *,
    observations: Observations | None = None,
    lens: Camera | None = None,
    side_views: bool = False,
    max_width: int | None = 1920,
    codec: str = "auto",
    overwrite: bool = False,
    force: bool = False,
    progress: ProgressTask = silent,
) -> Overlay:
    """Draw the birds of a result over its video, and write a contact sheet beside the video.

    The overlay shows the frames from the first to the last frame of the result. It shows the meshes, transparent and
    outlined in the colour of the track; fitted keypoints as dots, detected keypoints as rings; and the track number at
    the head, with the flag of a pose that is not `ok`. A result with error bars also shows the 95 % region of every
    fitted keypoint, where the region is larger than the dot. `draw_birds` defines the order of overlapping birds. Below
    the image are a legend and, with `side_views`, every bird from its left (`SideViews`). The overlay of a result of
    every n-th frame has these frames only, at 1/n of the frame rate; frames that the result lacks between them show the
    footage.

    Args:
        solution: the result.
        bird: the model of the result.
        video: the video of the result, a file or a folder of images.
        out: the ``.mp4`` or ``.webm`` to write; the contact sheet has the same name with the suffix ``.png``.
        observations: detected keypoints to draw.
        lens: the camera of the video with its distortion, for a solution of `jaxfit.data.world.as_filmed`.
        side_views: add the strip of side views.
        max_width: greatest width in pixels; a wider video is scaled down. None keeps the size.
        codec: codec of `VideoWriter`.
        overwrite: replace existing output files, but never the footage.
        force: draw also on a video that is not the video of the result; frames that the video lacks are missing then.
        progress: shows the progress over frames.

    Returns:
        The written files and their properties.

    Raises:
        ValueError: `max_width` below 16.
        InputError: the video does not exist; without `force`, the video has another image size, number of frames or
            first frame than the video of the result, or the observations have another image size; the video has no
            frame of the result; the observations share no bird with the result; the result has no valid pose, or images
            of several sizes; an output file exists without `overwrite`, or is the footage; `out` cannot hold the codec;
            or the system rejects the write. Nothing is written then.
    """
    video, out = Path(video), Path(out)
    if max_width is not None and max_width < 16:
        raise ValueError(f"max_width must be 16 or more, or None, not {max_width}")
    info = probe_video(video)
    check_outputs([out, out.with_suffix(".png")], video, overwrite)
    check_belongs(solution, observations, video, info, force)
    drawing = _Drawing(solution, bird, observations, lens, side_views, info, max_width)
    numbers = solution.frame_index
    step = frame_step(numbers)
    first, last = int(numbers[0]), int(numbers[-1])
    fps = (info.fps or FOLDER_FPS) / step
    wanted = [pair for row in sheet_pairs(solution) for pair in row]
    tiles = {}

    def frames() -> Iterator[_Frame]:
        for number, picture, time_s in read_frames(video, first, last + 1, step):
            t = int(np.searchsorted(numbers, number))
            here = t if numbers[t] == number else None
            tiles.update(cut_tiles(drawing.posed, picture, [(n, at) for n, at in wanted if at == here]))
            yield drawing.prepare(picture, number, here, number / (fps * step) if time_s is None else time_s)

    def drawn(frame: _Frame) -> tuple[int, UInt8[np.ndarray, "H W 3"]]:
        return frame.number, drawing.draw(frame)

    with (
        VideoWriter(out, drawing.size_px, max(fps, SLOWEST_FPS), codec, b_frames=False) as writer,
        progress("overlay", (last - first) // step + 1) as report_progress,
        closing(in_threads(drawn, frames(), usable_cores())) as images,
    ):
        number = None
        for number, image in images:
            writer.write(image)
            report_progress(1, f"frame {number}")
        if number is None or (info.frames is None and number != last and not force):
            raise too_short(video, solution, (info.frames or 0) if number is None else number + 1)
    contact_sheet(solution, bird, observations, out.with_suffix(".png"), footage=tiles, lens=lens)
    return Overlay(
        out,
        out.with_suffix(".png"),
        writer.frames,
        writer.written_size_px,
        float(writer.fps),
        writer.codec,
        writer.fallback,
    )


def overlay_frame(
    solution: Solution,
    bird: Bird,
    video: str | Path,
    frame_index: int,
    out: str | Path,
    *,
    observations: Observations | None = None,
    lens: Camera | None = None,
    side_views: bool = False,
    max_width: int | None = 1920,
    overwrite: bool = False,
    force: bool = False,
) -> None:
    """Draw one frame as `overlay` does, and write the image.

    Args:
        frame_index: number of the frame in the video.
        out: the ``.png`` or ``.jpg`` to write.
        solution, bird, video, observations, lens, side_views, max_width, overwrite, force: as for `overlay`.

    Raises:
        InputError: as for `overlay`; or the result lacks the frame, or `out` has another suffix.
    """
    video, out = Path(video), Path(out)
    info = probe_video(video)  # reports a missing video
    check_outputs([out], video, overwrite)
    if out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise InputError(out, f"an image cannot end in {out.suffix!r}", "give a name that ends in .png or .jpg")
    drawn = overlay_pictures(
        solution,
        bird,
        video,
        [frame_index],
        observations=observations,
        lens=lens,
        side_views=side_views,
        max_width=max_width,
        force=force,
    )
    _, image = next(drawn, (None, None))
    if image is None:
        raise too_short(video, solution, info.frames or 0)
    write_whole(out, cv2.imencode(out.suffix, image)[1].tobytes())


def overlay_pictures(
    solution: Solution,
    bird: Bird,
    video: str | Path,
    frames: Sequence[int],
    *,
    observations: Observations | None = None,
    lens: Camera | None = None,
    side_views: bool = False,
    max_width: int | None = 1920,
    force: bool = False,
) -> Iterator[tuple[int, UInt8[np.ndarray, "H W 3"]]]:
    """Draw some frames as `overlay` does, and yield the number and the image (blue, green, red) of each frame.

    Args:
        frames: numbers of frames in the video, in increasing order.
        solution, bird, video, observations, lens, side_views, max_width, force: as for `overlay`.

    Raises:
        InputError: as for `overlay`; or the result or the video lacks a frame.
    """
    video = Path(video)
    info = probe_video(video)
    check_belongs(solution, observations, video, info, force)
    for frame in frames:
        if frame not in solution.frame_index:
            problem = f"has no frame {frame}: its frames are {solution.frame_index[0]} to {solution.frame_index[-1]}"
            raise InputError("result", problem, "give one of these frames")
    drawing = _Drawing(solution, bird, observations, lens, side_views, info, max_width)
    for frame in frames:
        found = next(iter(read_frames(video, frame, frame + 1)), None)
        if found is None and force:
            continue
        if found is None:
            raise too_short(video, solution, 0)
        number, picture, time_s = found
        t = int(np.searchsorted(solution.frame_index, number))
        seconds = number / FOLDER_FPS if time_s is None else time_s
        yield number, drawing.draw(drawing.prepare(picture, number, t, seconds))


class _Frame(NamedTuple):
    """What is drawn in a frame."""

    picture: UInt8[np.ndarray, "H W 3"]
    number: int
    t: int | None
    """Position in the result; None if the result lacks the frame."""
    seconds: float
    birds: list[DrawnBird]
    tags: list[Number]
    meshes_cam: list[Float[np.ndarray, "V 3"]]
    """Meshes of all tracks, for the side views; empty without them."""


class _Drawing:
    """Draws the frames of an overlay: `prepare` in increasing order, `draw` in any order and thread."""

    def __init__(
        self,
        solution: Solution,
        bird: Bird,
        observations: Observations | None,
        lens: Camera | None,
        side_views: bool,
        info: VideoInfo,
        max_width: int | None,
    ):
        width, height = info.size_px
        self.zoom = 1.0 if max_width is None else min(1.0, max_width / width)
        self.picture_px = round(width * self.zoom), max(1, round(height * self.zoom))
        # linear interpolation is much faster, and as good while it still reads every pixel
        self._shrink = cv2.INTER_LINEAR if self.zoom > 0.6 else cv2.INTER_AREA
        self.solution, self.posed = solution, PosedBirds(solution, bird, lens)
        extent = np.ptp(solution.keypoints.px[solution.valid], axis=1).max(-1)
        self.style = Style.suited(self.picture_px[0], float(np.median(extent)) * self.zoom)
        self._numbers = Numbers(solution.keypoint_names, self.style)
        self._faces = np.asarray(bird.faces)
        self._colours = [tinted(np.asarray(bird.vertex_colours), n) for n in range(len(solution.track_id))]
        self._pairs = skeleton_pairs(solution.keypoint_names)
        self._detected = Detected(solution, observations)
        text_px = self.style.text_px
        self._flags = flags(solution.flags.doubts)
        self._legend = Legend(
            self.picture_px[0],
            self.style,
            detected=observations is not None,
            side_views=side_views,
            regions=solution.error_bars is not None,
            flagged=bool(np.isin(self._flags, (UNSURE, CONTRADICTED)).any()),
        )
        self._side = SideViews(solution, bird, self.picture_px[0], text_px) if side_views else None
        strip = 0 if self._side is None else self._side.height
        self.size_px = self.picture_px[0], self.picture_px[1] + self._legend.height + strip
        self._start, self._cam = 0, np.zeros((0, 0, 0, 3), np.float32)

    def prepare(self, picture: UInt8[np.ndarray, "H W 3"], number: int, t: int | None, seconds: float) -> _Frame:
        """Return what is drawn in a frame; `t` is the position in the result, None if the result lacks the frame."""
        birds = [] if t is None else [self._bird(n, t) for n in np.flatnonzero(self.solution.valid[:, t]).tolist()]
        tags, meshes = self._numbers.place(self.picture_px, birds), []
        if self._side is not None and t is not None:
            meshes = [self._vertices_cam(n, t) for n in range(len(self.solution.track_id))]
        return _Frame(picture, number, t, seconds, birds, tags, meshes)

    def draw(self, frame: _Frame) -> UInt8[np.ndarray, "H2 W2 3"]:
        """Return the image of a frame."""
        image = np.empty((self.size_px[1], self.size_px[0], 3), np.uint8)
        low = self.picture_px[1]
        if self.zoom == 1:
            image[:low] = frame.picture
        else:
            image[:low] = cv2.resize(frame.picture, self.picture_px, interpolation=self._shrink)
        shown = np.zeros(len(self.solution.track_id), bool) if frame.t is None else self.solution.valid[:, frame.t]
        crops = np.zeros((0, 3)) if frame.t is None else self.solution.crops.square_px[shown, frame.t]
        draw_birds(image[:low], frame.birds, self._faces, self.style, one_camera=bool((crops == crops[:1]).all()))
        for bird in frame.birds:
            draw_regions(image[:low], bird, self.style)
        for bird in frame.birds:
            draw_keypoints(image[:low], bird, self._pairs, self.style)
        for each in frame.tags:
            each.draw(image[:low], self.style)
        image[low : low + self._legend.height] = self._legend.draw(frame.number, frame.seconds)
        if self._side is not None:
            image[low + self._legend.height :] = self._side.draw(frame.t or 0, shown, frame.meshes_cam)
        return image

    def _bird(self, n: int, t: int) -> DrawnBird:
        cam, span = self._vertices_cam(n, t), slice(t, t + 1)
        shrink = np.array([self.zoom, self.zoom, 1], np.float32)
        places, confidence = self._detected.keypoints(n, t)
        points, bars, regions = self.solution.keypoints.px[n, t] * self.zoom, self.solution.error_bars, None
        if bars is not None:
            half = float(self.solution.crops.square_px[n, t, 2]) / 2 * self.zoom
            regions = regions_95(points, bars.keypoints_px_cov[n, t] * self.zoom**2, half)
        return DrawnBird(
            position=n,
            name=with_flag(str(self.solution.track_id[n]), self._flags[n, t]),
            screen=self.posed.to_image(cam[None], n, span)[0] * shrink,
            colours=shade(cam, self._faces, self._colours[n]),
            keypoints_px=points,
            detected_px=places[confidence > 0] * self.zoom,
            regions_px=regions,
        )

    def _vertices_cam(self, n: int, t: int) -> Float[np.ndarray, "V 3"]:
        """Return the mesh of a bird; all meshes of a chunk of frames are posed together, when the chunk begins."""
        if not self._start <= t < self._start + self._cam.shape[1]:
            # the last chunk starts earlier instead of being shorter: all chunks have one length and one compilation
            self._start = max(0, min(t, len(self.solution.frame_index) - CHUNK))
            span = slice(self._start, self._start + CHUNK)
            self._cam = np.stack([self.posed.vertices_cam_window(i, span) for i in range(len(self.solution.track_id))])
        return self._cam[n, t - self._start]
