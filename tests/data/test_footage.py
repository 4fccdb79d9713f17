"""The identity of the footage goes from the video through observations and fit into the result."""

import dataclasses
import json

import numpy as np
import pytest
from support.overlays import BIRD, film, solution
from support.toy_footage import FRAMES, Footage, TrueKeypoints, TrueSegmenter

from jaxfit.config.perception import TrackConfig
from jaxfit.data.footage import FootageIdentity, footage_of, read_footage
from jaxfit.data.formats.coco import read_coco, write_coco
from jaxfit.data.formats.fields import Field
from jaxfit.data.formats.image_sizes import add_times
from jaxfit.data.projection import projected_observations
from jaxfit.data.solution import load_solution, save_solution
from jaxfit.fitting.collect import summarise
from jaxfit.foundation.errors import InputError
from jaxfit.perception.track import track_video

KNOWN = FootageIdentity(40, bytes(range(256)) * 4)


def test_tracking_stores_the_identity_of_the_whole_video(tmp_path):
    """Also if only later frames are tracked."""
    footage = Footage()
    frames = footage.write(tmp_path / "frames")
    config = TrackConfig(min_track_frames=1)
    late = dataclasses.replace(config, frames=dataclasses.replace(config.frames, start=4, stop=9, step=2))
    networks = TrueSegmenter(footage, []), TrueKeypoints(footage)
    whole, part = (track_video(frames, each, *networks).footage for each in (config, late))
    assert whole == part == read_footage(frames, FRAMES)
    assert (whole.frames, len(whole.first_frame)) == (FRAMES, 1024)


@pytest.mark.parametrize("footage", [KNOWN, FootageIdentity(7), FootageIdentity(None, KNOWN.first_frame), None])
def test_observations_and_results_keep_the_identity(tmp_path, footage):
    made = dataclasses.replace(solution(), footage=footage)
    save_solution(made, BIRD, "", summarise(made, BIRD, {}), tmp_path / "result")
    assert load_solution(tmp_path / "result")[0].footage == footage
    observed = dataclasses.replace(projected_observations(solution()), footage=footage)
    assert observed.select([0], [1, 2]).footage == footage
    write_coco(observed, tmp_path / "birds.json")
    assert read_coco(tmp_path / "birds.json").footage == footage


def test_imported_keypoints_get_the_identity_of_their_video(tmp_path):
    video = film(tmp_path / "film.mp4")
    bare = dataclasses.replace(projected_observations(solution()), timestamp_s=None, fps=None)
    assert add_times(bare, video).footage == read_footage(video, 11)
    assert add_times(bare, None).footage is None


def test_first_frames_differ_beyond_the_tolerance_only():
    near, far = (bytes(np.frombuffer(KNOWN.first_frame, np.uint8) // 2 + add) for add in (12, 40))
    half = FootageIdentity(3, bytes(np.frombuffer(KNOWN.first_frame, np.uint8) // 2))
    assert not half.differs(FootageIdentity(9, near))  # `differs` is about pictures only
    assert half.differs(FootageIdentity(3, far))
    assert not half.differs(FootageIdentity(3))


@pytest.mark.parametrize("entries", [{"frames": -1}, {"frames": "many"}, {"first_frame": "AAAA"}, {"first_frame": 3}])
def test_other_values_are_errors(tmp_path, entries):
    with pytest.raises(InputError, match=rf"footage\.{next(iter(entries))}"):
        footage_of(Field(tmp_path / "birds.json", "footage", entries))
    path = tmp_path / "birds.json"
    write_coco(projected_observations(solution()), path)
    path.write_text(json.dumps({**json.loads(path.read_text()), "info": {"footage": entries}}))
    with pytest.raises(InputError, match=rf"birds\.json: info\.footage\.{next(iter(entries))}"):
        read_coco(path)
