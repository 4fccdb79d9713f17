"""Limits on input: what jaxfit rejects before it takes memory or time that a damaged file could demand.

Each limit is far above real input. docs/limits.md lists all of them.
"""

# --- messages
MESSAGE_CHARACTERS = 300
"""Longest message of an error or a warning on the command line."""

# --- images and masks
IMAGE_SIDE_PX = 16_384
"""Longest side of an image or a mask. The run lengths of larger masks overflow the buffers of pycocotools."""

# --- files of other tracking programs
TABLE_VALUES = 2**25
"""Most entries of N birds × T frames × K keypoints in one file: an hour of 15 birds with 25 keypoints at 25 frames per
second."""
TABLE_KEYPOINTS = 1_000
"""Most keypoints of a bird in one file."""
TABLE_BIRDS = 5_000
"""Most birds in one file."""
TABLE_PICTURES = 200_000
"""Most labelled pictures in one file."""
NAME_CHARACTERS = 255
"""Longest name of a keypoint, bird, picture or video; tables of names take the length of the longest name for every
frame."""
FRAME_DIGITS = 15
"""Most digits of a frame number in the name of a picture."""
CONFIDENCE = 10.0
"""Largest score of a keypoint. Scores between 1 and this limit count as 1: peaks of a network may lie above 1."""
CSV_BYTES = 2_000_000_000
"""Largest CSV file: a million frames of 30 keypoints."""
HDF5_BYTES = 1_000_000_000
"""Largest array that is read from an HDF5 file, without compression."""
HDF5_ENTRIES = 10_000
"""Most entries of a folder inside an HDF5 file."""
HDF5_TEXTS = 100_000
"""Most texts of an array of texts in an HDF5 file, such as the names of tracks."""
HDF5_TEXT_BYTES = 10_000_000
"""Largest text that is read from an HDF5 file."""
NAME_MAP_BYTES = 100_000
"""Largest file that maps names of keypoints."""
MASKS_PER_PICTURE = 100
"""Most connected regions of a picture of masks."""
