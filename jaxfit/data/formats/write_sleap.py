"""Project files of SLEAP (`.slp`) with predictions on pictures or on a video, for correction in SLEAP.

SLEAP shows a prediction, and a double click turns the prediction into a label. Every picture is also a suggestion, so
that SLEAP lists the pictures without a bird too. SLEAP has no place for hidden keypoints, boxes and masks.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from jaxfit.data.observations import Observations
from jaxfit.foundation.extras import require_extra
from jaxfit.foundation.files import write_whole


def write_sleap_project(observations: Observations, footage: Sequence[str] | str, path: str | Path) -> None:
    """Write observations as the predictions of a SLEAP project.

    Args:
        observations: the predictions; tracks without a bird are left out.
        footage: T paths of the pictures of the frames, all of one size; or the path of a video, in which a frame has
            its number. SLEAP looks for relative paths in the folder where it was started.
        path: the file; an existing file is replaced.

    Raises:
        InputError: the extra `formats` is not installed, or the file cannot be written.
    """
    require_extra("formats", str(path), "sleap-io")
    import sleap_io

    sio: Any = sleap_io

    on_video = isinstance(footage, str)
    numbers = observations.frame_index.tolist() if on_video else list(range(len(footage)))
    width, height = observations.image_size_px[0].tolist()
    shape = [numbers[-1] + 1, height, width, 3]
    # sleap-io writes a video that it has not opened by its metadata, which must have the keys that SLEAP reads
    stored = {"shape": shape, "filename": footage, "type": "MediaVideo", "grayscale": False, "bgr": True}
    if not on_video:
        stored = {"shape": shape, "filename": footage[0], "filenames": list(footage), "type": "ImageVideo"}
        stored |= {"height_": height, "width_": width, "channels_": 3, "grayscale": False}
    video = sio.Video(footage if on_video else list(footage), backend_metadata=stored, open_backend=False)
    nodes = list(observations.keypoint_names)
    skeleton = sio.Skeleton(nodes, edges=[(nodes[a], nodes[b]) for a, b in observations.skeleton], name="bird")
    tracks = {n: sio.Track(f"bird {observations.track_id[n]}") for n in np.flatnonzero(observations.present.any(1))}
    frames = []
    for t, number in enumerate(numbers):
        birds = []
        for n in np.flatnonzero(observations.present[:, t]):
            confidence = observations.confidence[n, t]
            birds.append(
                sio.PredictedInstance.from_numpy(
                    np.where(confidence[:, None] > 0, observations.keypoints_px[n, t], np.nan),
                    skeleton,
                    point_scores=confidence,
                    score=float(cast(np.ndarray, observations.score)[n, t]),
                    track=tracks[n],
                )
            )
        frames.append(sio.LabeledFrame(video=video, frame_idx=number, instances=birds))
    suggestions = [] if on_video else [sio.SuggestionFrame(video, number) for number in numbers]
    labels = sio.Labels(
        frames, videos=[video], skeletons=[skeleton], tracks=list(tracks.values()), suggestions=suggestions
    )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "labels.slp"
        labels.save(str(file), embed=False, verbose=False)
        write_whole(path, file.read_bytes())
