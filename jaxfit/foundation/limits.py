"""Limits on input: jaxfit rejects larger input before it uses memory or time.

Each limit is far above real input.
"""

# --- images and masks
IMAGE_SIDE_PX = 16_384
"""Longest side of an image or a mask. The run lengths of larger masks overflow the buffers of pycocotools."""

# --- birds far outside their image, and crops
DISTANCE_IMAGE_SIDES = 1.0
"""Largest distance of a box or a keypoint outside its image, as a multiple of the image's longer side. A fit skips and
reports frames with a larger distance."""
CROP_IMAGE_SIDES = 2
"""Largest side of a crop, as a multiple of the longer side of its image."""

# --- masks of files
MASK_RUNS = 1_000_000
"""Largest number of runs of one mask. Reading the runs takes about a second at this limit."""
POLYGONS = 256
"""Largest number of polygons of one mask."""
POLYGON_LENGTH_PX = 1_000_000
"""Largest length of the outlines of one mask. pycocotools takes time and memory for every pixel of an edge."""

# --- configs: memory and time of a fit
WINDOW_FRAMES = 10_000
"""Largest number of frames of a window."""
FILTER_FRAMES = 1001
"""Largest window of the median filter, in frames."""
CROP_SIZE_PX = 1024
"""Largest side of the crops in which silhouettes are compared."""
CROP_PADDING = 10.0
"""Largest margin of a crop, as a fraction of the box."""
FOCAL_PX = 1e6
"""Largest focal length of the crop camera."""
KEYPOINT_OFFSET = 1e4
"""Largest offset of a keypoint, model units."""
STAGES = 50
"""Largest number of stages of a fit; each stage compiles a program."""
STEPS = 100_000
"""Largest number of steps of a stage."""
LEARNING_RATE = 1e3
"""Largest step size of Adam."""
BLUR = 10.0
"""Largest blur of a silhouette; the time of a silhouette grows with the square of the blur."""
CONFIG_NUMBER = 1e30
"""Largest weight, setting or factor of a config; a product with a step size must not overflow."""
TURNS = 3600
"""Largest number of rotations about the viewing axis in the search for initial poses."""
DIRECTIONS = 10_000
"""Largest number of viewing directions in the search for initial poses."""
ORIENTATIONS = 100_000
"""Largest number of turns × directions."""
CANDIDATES = 1000
"""Largest number of candidates per frame in the search for initial poses."""
SMOOTHNESS = 1e12
"""Largest cost of a rotation in the search for initial poses."""
HYPOTHESES = 100
"""Largest number of initial poses that are fitted side by side."""
KEYPOINTS = 1000
"""Largest number of keypoints of a bird."""
MEMORY_GB = 1000.0
"""Largest `memory_gb` of a config."""
WINDOW_GB = 8.0
"""Largest memory of one window, by estimate, unless `memory_gb` is larger."""

# --- configs: tracking and overlay
FRAME_NUMBER = 10**9
"""Largest frame number of a config."""
TRACKER_MEMORY = 100_000
"""Largest number of frames that a tracker remembers a bird."""
CROPS_PER_CALL = 1024
"""Largest number of crops of one call of a keypoint network."""
CROP_MARGIN_PX = 4096
"""Largest margin of a crop for the keypoint network, and largest side of the square that dilates a mask."""
TILE_OVERLAP = 0.9
"""Largest overlap of neighbouring tiles, as a fraction of a tile's side."""
THREADS = 1024
"""Largest number of CPU cores."""

# --- configs and grids
CONFIG_LEVELS = 50
"""Largest depth of lists and mappings inside each other in a config. The shipped configs have up to 6 levels."""
CONFIG_VALUES = 100_000
"""Largest number of keys, values, lists and mappings in a config; an alias counts with all values of its anchor."""
CONFIG_DIGITS = 100
"""Most characters of a number in a config."""
CONFIG_KEY_CHARACTERS = 1_000
"""Longest key in a config."""
CONFIG_BASES = 20
"""Most files in a chain of bases of one config."""
GRID_RUNS = 10_000
"""Most runs of a grid or a sweep. The grid of the paper has 34 runs."""

# --- pictures and videos
IMAGE_PIXELS = 100_000_000
"""Most pixels of a picture or of a frame of a video: 300 MB in memory."""
PICTURE_SCANS = 100
"""Most scans of a progressive JPEG picture. Every scan takes the time of a whole picture; usual are ten."""
FRAMES_PER_S = 100_000
"""Highest frame rate of a video. A higher rate counts as unknown."""
SECONDS_PER_FRAME = 100_000
"""Longest time between the frames of a video. A lower frame rate counts as unknown."""
TIMESTAMP_S = 1e9
"""Largest absolute time stamp of a frame in a file of observations, in seconds."""
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
ACTIVATION_CHANNELS = 1024
"""Most channels of the statistics of a network's activations in its metadata; the matrix of 1024 channels has 4 MB."""
CURVE_POINTS = 1000
"""Most points of a curve that calibrates confidences in a network's metadata."""
CLASSES = 100_000
"""Most classes of a network."""
DETECTIONS = 10_000
"""Most boxes of a frame that are compared with each other. Boxes with lower scores are dropped."""
INSTANCES = 1000
"""Most instances of a frame."""
MASK_AREA = 50
"""Most area of all boxes of a frame's instances, as a multiple of the frame."""

# --- observations and truths
TEXT_CHARACTERS = 4096
"""Longest name in a COCO file or a scene; tables of names take the length of the longest name for every frame."""

# --- arrays (.npz and .npy files)
NPY_DIMENSIONS = 8
"""Dimensions of an array in an .npz or .npy file."""
NPZ_TEXT_CHARACTERS = 1000
"""Length of one text in an array of texts."""

# --- bird models
MODEL_VERTICES = 100_000
"""Vertices of a bird model."""
MODEL_FACES = 200_000
"""Faces of a bird model."""
MODEL_JOINTS = 256
"""Joints of a bird model."""
MODEL_KEYPOINTS = 256
"""Keypoints of a bird model."""
MODEL_SHAPES = 256
"""Shape coefficients of a bird model."""
CHECKPOINT_OPCODES = 200_000
"""Length of the pickle of a PyTorch checkpoint."""
CHECKPOINT_ENTRIES = 10_000
"""Files in a PyTorch checkpoint."""

# --- scans
SCAN_BYTES = 2 << 30
"""Largest file of a scan."""
SCAN_FACES = 20_000_000
"""Most faces of a scan. A scan of more than 150,000 faces is decimated."""

# --- written files
NAME_BYTES = 255
"""Length of one name in a path."""
LEFTOVER_DAYS = 7
"""Age at which jaxfit removes the temporary files of a killed process of another computer on a shared disk."""

# --- files of other tracking programs
TABLE_VALUES = 2**26
"""Most entries of N birds × T frames × K keypoints in one file, which take 0.9 GB: nearly two hours of 15 birds with 25
keypoints at 25 frames per second."""
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
HDF5_BYTES = 1_000_000_000
"""Largest array that is read from an HDF5 file, without compression."""
HDF5_ENTRIES = 10_000
"""Most entries of a folder inside an HDF5 file."""
HDF5_TEXTS = 100_000
"""Most texts of an array of texts in an HDF5 file, such as the names of tracks."""
HDF5_TEXT_BYTES = 10_000_000
"""Largest text that is read from an HDF5 file."""
MASKS_PER_PICTURE = 100
"""Most connected regions of a picture of masks."""

# --- cameras
CAMERAS = 1000
"""Most cameras of one file or folder."""
CAMERA_BYTES = 2_000_000
"""Largest file of cameras; of a .mat file, the variables that describe cameras, without compression. A camera takes
about 1,000 bytes."""
CAMERA_LEVELS = 50
"""Largest depth of lists and mappings inside each other in a file of cameras. Real files have up to 5 levels."""
MAT_VARIABLES = 1000
"""Most variables in a .mat file."""
