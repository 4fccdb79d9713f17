"""COCO json: files that would take much time or memory are rejected at once, with the figure and a remedy."""

import pytest
from support.coco_files import content, saved

from jaxfit.data.formats.coco import read_coco
from jaxfit.errors import InputError
from jaxfit.limits import IMAGE_SIDE_PX, POLYGON_LENGTH_PX, POLYGONS


def rejected(tmp_path, data, message):
    with pytest.raises(InputError, match=message):
        read_coco(saved(tmp_path, data))


def large_image(segmentation):
    data = content()
    for image in data["images"]:
        image["width"] = image["height"] = IMAGE_SIDE_PX
    data["annotations"] = [data["annotations"][4] | {"segmentation": segmentation}]
    return data


def zigzag(points):
    side = IMAGE_SIDE_PX - 1
    return [value for i in range(points) for value in (side * (i % 2), i * 7 % side)]


def test_the_length_of_polygons_is_bounded(tmp_path):
    rejected(tmp_path, large_image([zigzag(8000)]), r"segmentation has outlines of 1.31e\+08 pixels .*simplify")
    rejected(tmp_path, large_image([zigzag(40)] * 2), r"has outlines of 1.31e\+06 pixels")
    longest = zigzag(POLYGON_LENGTH_PX // IMAGE_SIDE_PX)
    assert read_coco(saved(tmp_path, large_image([longest]))).masks
    triangles = [[1, 1, 9, 1, 5, 9]] * (POLYGONS + 1)
    rejected(tmp_path, large_image(triangles), "segmentation has 257 polygons, more than 256")
    assert read_coco(saved(tmp_path, large_image(triangles[1:]))).masks


def test_the_number_of_runs_is_bounded(tmp_path):
    data = content()
    data["annotations"][3]["segmentation"]["counts"] = [0] * 602 + [600]
    rejected(tmp_path, data, "counts has 603 runs, more than the 600 pixels")
    data["annotations"][3]["segmentation"]["counts"] = [0, 600, 0]
    assert read_coco(saved(tmp_path, data)).mask(0, 0).all()
