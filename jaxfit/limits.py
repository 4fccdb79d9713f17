"""Limits on input: what jaxfit rejects before it takes memory or time that a damaged file could demand.

Each limit is far above real input. docs/limits.md lists all of them.
"""

# --- messages
MESSAGE_CHARACTERS = 300
"""Longest message of an error or a warning on the command line."""

# --- images and masks
IMAGE_SIDE_PX = 16_384
"""Longest side of an image or a mask. The run lengths of larger masks overflow the buffers of pycocotools."""

# --- pictures and videos
IMAGE_PIXELS = 100_000_000
"""Most pixels of a picture or of a frame of a video: 300 MB in memory."""
PICTURE_BYTES = 1 << 30
"""Largest file of a picture."""
PICTURE_SCANS = 100
"""Most scans of a progressive JPEG picture. Every scan takes the time of a whole picture; usual are ten."""
FRAMES_PER_S = 100_000
"""Highest frame rate of a video. A higher rate counts as unknown."""
SECONDS_PER_FRAME = 100_000
"""Longest time between the frames of a video. A lower frame rate counts as unknown."""
VIDEO_GAP_FRAMES = 100_000
"""Most frames that damage can hide at one place of a video. A longer gap of the time stamps counts as damaged."""

# --- networks
NETWORK_BYTES = 4 << 30
"""Largest file of a network."""
NETWORK_INPUT_VALUES = 3 << 26
"""Most values of an input of a network: 800 MB of floats, a picture of 8192×8192."""
NETWORK_ASPECT = 8
"""Largest ratio of the sides of a keypoint network's input. The crop of a bird has the same ratio."""
METADATA_CHARACTERS = 1_000_000
"""Longest text that is read as a Python literal from a network's metadata, such as the names of its classes."""
METADATA_DEPTH = 10
"""Most levels of brackets in such a text."""
CLASSES = 100_000
"""Most classes of a network."""
CROP_MARGIN_PX = 2000
"""Largest margin and largest dilation of a bird's crop in the metadata of a keypoint network."""
DETECTIONS = 10_000
"""Most boxes of a frame that are compared with each other. Boxes with lower scores are dropped."""
INSTANCES = 1000
"""Most instances of a frame."""
MASK_AREA = 50
"""Most area of all boxes of a frame's instances, as a multiple of the frame."""
