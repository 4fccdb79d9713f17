"""Camera files of other programs for the tests of `jaxfit.cameras.files`."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

MATRIX = np.array([[1200.0, 0, 640.25], [0, 1180.0, 355.5], [0, 0, 1]])
FIVE = np.array([-0.28, 0.09, 1e-3, -5e-4, -0.01])
RVEC = np.array([0.2, -0.4, 0.1])
ROTATION = cv2.Rodrigues(RVEC)[0]
TRANSL = np.array([0.1, -0.2, 2.0])
OTHER = cv2.Rodrigues(np.array([-0.1, 0.5, 0.3]))[0], np.array([-0.3, 0.1, 2.5])

ANIPOSE = """
[cam_0]
name = "A"
size = [ 1280, 720,]
matrix = [ [ 1203.25, 0.0, 641.5,], [ 0.0, 1199.5, 358.75,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.21, 0.08, 0.0, 0.0, 0.0,]
rotation = [ 0.02, -0.4, 0.1,]
translation = [ 12.5, -30.0, 1500.0,]

[cam_1]
name = "back"
size = [ 1024, 768,]
matrix = [ [ 700.5, 0.0, 512.0,], [ 0.0, 698.25, 380.5,], [ 0.0, 0.0, 1.0,],]
distortions = [ 0.03, -0.01, 0.002, 0.0,]
rotation = [ 1e-5, 0.5, -0.2,]
translation = [ -40.0, 20.25, 1800.0,]
fisheye = true

[metadata]
adjusted = false
error = 0.41
"""
"""Written by aniposelib 0.8.0 (`CameraGroup.dump`)."""

STEREO = {"M1": MATRIX, "D1": FIVE[None], "M2": MATRIX, "D2": FIVE[None]}


def write_storage(path, values):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    write_values(storage, values)
    storage.release()


def write_values(storage, values):
    for name, value in values.items():
        if isinstance(value, dict):
            storage.startWriteStruct(name, cv2.FILE_NODE_MAP)
            write_values(storage, value)
            storage.endWriteStruct()
        else:
            storage.write(name, value)


def camera_values(matrix="camera_matrix", distortion="distortion_coefficients", R="R", T="T", pose=(ROTATION, TRANSL)):
    size = {"image_width": 1280, "image_height": 720}
    return {matrix: MATRIX, distortion: FIVE[None], **size, R: pose[0], T: pose[1][:, None]}


def matlab_values(R=ROTATION, transl=TRANSL, radial=(-0.28, 0.09, -0.01)):
    """Return the parameters as MATLAB's `cameraParameters` has them, for pixel centres at 1, 2, 3, …"""
    K = MATRIX + np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    values = {"K": K.T, "RDistort": np.array([radial]), "TDistort": np.array([FIVE[2:4]])}
    return values | {"r": R.T, "t": transl[None] * 1000}


def cell(values):
    array = np.empty((len(values), 1), object)
    array[:, 0] = values
    return array


COLMAP_CAMERAS = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 1
7 {}
"""
COLMAP_IMAGES = """# Image list with two lines of data per image:
#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
#   POINTS2D[] as (X, Y, POINT3D_ID)
# Number of images: 2, mean observations per image: 1
1 {} {} 7 {}
2362.39 248.498 58396 1784.7 268.254 59027 1784.7 268.254 -1
2 {} {} 7 {}

"""


def write_colmap(folder, model="PINHOLE 1280 720 1200 1180 640.25 355.5", names=("left/0.jpg", "right/0.jpg")):
    poses = []
    for (R, transl), name in zip([(ROTATION, TRANSL), OTHER], names, strict=True):
        quaternion = np.roll(Rotation.from_matrix(R).as_quat(), 1)
        poses += [" ".join(map(repr, values.tolist())) for values in (quaternion, transl)] + [name]
    (folder / "cameras.txt").write_text(COLMAP_CAMERAS.format(model))
    (folder / "images.txt").write_text(COLMAP_IMAGES.format(*poses))
