"""Results as files of other tools: the formats and their options."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["FORMATS", "Format"]


class Format(NamedTuple):
    """A format: its writer, its file names and its options."""

    module: str
    """Module of `jaxfit.export` with the writer."""
    function: str
    """The writer: takes the result, the output, the progress and the options of the format."""
    tools: str
    """What opens the files."""
    suffixes: tuple[str, ...] = ()
    """Accepted ends of the file name."""
    options: tuple[str, ...] = ()
    folder: bool = False
    """Whether the output is a folder, unless its name ends with one of the suffixes."""


FORMATS = {
    "csv": Format("tables", "write_csv", "R, spreadsheets, pandas", (".csv",)),
    "parquet": Format("tables", "write_parquet", "R, pandas, polars, DuckDB", (".parquet",)),
    "movement": Format("pose_files", "write_movement", "movement, xarray, napari", (".nc",), ("space", "dims")),
    "glb": Format("glb", "write_glb", "Blender, three.js, viewers", (".glb",), ("ground",), True),
    "nwb": Format("pose_files", "write_nwb", "pynwb, NWB Explorer, DANDI", (), ("start",), True),
    "coco": Format("pose_files", "write_coco_keypoints", "CVAT, programs that read COCO", (".json",)),
    "slp": Format("pose_files", "write_slp_keypoints", "SLEAP", (".slp",)),
    "dlc": Format("pose_files", "write_dlc_keypoints", "DeepLabCut, napari-deeplabcut", (".h5", ".csv")),
}
"""Name of a format → format."""
