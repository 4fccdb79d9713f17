"""Draw what the features of behaviour measure, on murres.

`PYTHONPATH=tests .venv/bin/python -m support.feature_drawing` writes `docs/media/behaviour.svg`. The drawing
shows the angles and lengths that `describe` returns for the drawn birds.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.patches import Arc, FancyArrowPatch, PathPatch
from matplotlib.path import Path as Outline

from jaxfit.behaviour.describe import describe
from jaxfit.model.murre.postures import POSTURES
from jaxfit.raster.zbuffer import zbuffer
from support.described import BIRD, STANDING, bent, flock, mesh_by_hand, points_by_hand, result, turned

FILE = Path(__file__).resolve().parents[2] / "docs" / "media" / "behaviour.svg"
WIDTH, HEIGHT = 1000, 920
INK, FAINT, PALE, DARK, EDGE = "#222222", "#6f6f6f", "#f3efe8", "#c3cad3", "#7d858f"
BLUE, ORANGE, GREEN, PURPLE, RED, TEAL = "#1f5fa8", "#b85c00", "#2f7d32", "#7a3ea1", "#b3202a", "#00767a"
FINE = 4
"""Samples of an outline per pixel of the drawing."""


class Bird:
    """A posed murre: its mesh, and its points in the world by name, metres."""

    def __init__(self, body_pose, turn, place_m=(0.0, 0.0, 0.0)):
        self.vertices, _ = mesh_by_hand(body_pose, turn, place_m)
        self.joints, self.keypoints = points_by_hand(body_pose, turn, place_m)
        self.pose, self.turn, self.root = body_pose, turn, np.asarray(place_m, float)

    @property
    def forward(self):
        return self.turn[:, 1]

    @property
    def gaze(self):
        return self.keypoints["bill_tip"] - self.eyes

    @property
    def eyes(self):
        return (self.keypoints["left_eye"] + self.keypoints["right_eye"]) / 2


class View:
    """A parallel projection from the world (metres) to the drawing (pixels, y up)."""

    def __init__(self, right, up, at_px, px_per_m, centre_m=(0, 0, 0)):
        self.axes = np.array([right, up], float)
        self.at, self.scale, self.centre = np.array(at_px, float), px_per_m, np.asarray(centre_m, float)

    def __call__(self, points):
        return (np.asarray(points) - self.centre) @ self.axes.T * self.scale + self.at

    def angle(self, direction):
        """Return the angle of a direction in the drawing, degrees from the right, counter-clockwise."""
        x, y = np.asarray(direction) @ self.axes.T
        return np.degrees(np.arctan2(y, x))


class Sheet:
    """The drawing, in pixels with y up."""

    def __init__(self):
        self.figure = Figure(figsize=(WIDTH / 100, HEIGHT / 100), dpi=100, facecolor="white")
        self.axes = self.figure.add_axes((0, 0, 1, 1), xlim=(0, WIDTH), ylim=(0, HEIGHT))
        self.axes.set_axis_off()

    def bird(self, bird, view):
        """Draw a murre as an outline with its dark plumage."""
        toward = np.cross(*view.axes)
        screen = np.column_stack([view(bird.vertices), 10 - bird.vertices @ toward])
        low = np.floor(screen[:, :2].min(axis=0)) - 4
        size = np.ceil(screen[:, :2].max(axis=0)) + 4 - low
        screen[:, :2] = (screen[:, :2] - low) * FINE
        columns, rows = (size * FINE).astype(int).tolist()
        face = zbuffer(screen.astype(np.float32), BIRD.faces, columns, rows).face
        dark = np.asarray(BIRD.vertex_colours)[np.asarray(BIRD.faces)].mean(axis=(1, 2)) < 0.45
        for mask, fill, edge in ((face >= 0, PALE, EDGE), ((face >= 0) & dark[face], DARK, "none")):
            patch = PathPatch(_outline(mask, low), facecolor=fill, edgecolor=edge, linewidth=1.2)
            self.axes.add_patch(patch)

    def line(self, *points, colour=INK, width=1.6, dashed=False):
        x, y = np.array(points).T
        style = {"linestyle": (0, (4, 3))} if dashed else {}
        self.axes.plot(x, y, color=colour, linewidth=width, solid_capstyle="round", zorder=3, **style)

    def arrow(self, start, end, colour=INK, both=False, width=2.0):
        style = "<|-|>" if both else "-|>"
        how = {"arrowstyle": style, "mutation_scale": 13, "shrinkA": 0, "shrinkB": 0}
        self.axes.add_patch(FancyArrowPatch(start, end, color=colour, linewidth=width, zorder=4, **how))

    def arc(self, centre, radius, first, second, colour):
        """Draw the smaller arc between two angles in degrees."""
        low, high = (first, second) if (second - first) % 360 < 180 else (second, first)
        arc = Arc(centre, 2 * radius, 2 * radius, theta1=low, theta2=high, color=colour, linewidth=2.2, zorder=4)
        self.axes.add_patch(arc)

    def dot(self, *points, colour=INK, size=5):
        for x, y in points:
            self.axes.plot(x, y, "o", color=colour, markersize=size, zorder=5)

    def text(self, at, words, colour=INK, size=13, align="left", weight="normal", rotation=0.0):
        how = {"ha": align, "va": "center", "zorder": 6, "fontweight": weight, "rotation": rotation}
        self.axes.text(*at, words, color=colour, fontsize=size * 0.72, **how)


def _outline(mask, low):
    """Return the outlines of a mask, with holes, as one path in pixels of the drawing."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    parts = []
    for contour in contours:
        points = cv2.approxPolyDP(contour, 1.0, True)[:, 0]
        if cv2.contourArea(contour) > 8 * FINE**2:
            parts.append(Outline(np.vstack([points, points[:1]]) / FINE + low + 0.5 / FINE, closed=True))
    return Outline.make_compound_path(*parts)


def towards(start, angle, length):
    """Return the point at a distance from another point, in a direction in degrees."""
    return np.asarray(start) + length * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])


def beside(point, x, y):
    """Return the point that lies x to the right of another point, and y above it."""
    return np.add(point, (x, y))


def crossing(first, angle_1, second, angle_2):
    """Return where two lines meet, each given by a point and a direction in degrees."""
    a, b = (towards((0, 0), angle, 1) for angle in (angle_1, angle_2))
    share = np.linalg.solve(np.column_stack([a, -b]), np.asarray(second) - first)
    return np.asarray(first) + share[0] * a


def values_of(*birds, moved_m=None):
    """Return the features of birds, which move by `moved_m` per second."""
    time_s = np.arange(11) / 25 - 0.2
    moved = np.zeros((len(birds), 3)) if moved_m is None else np.asarray(moved_m)
    place = np.stack([bird.root for bird in birds])[:, None] + moved[:, None] * time_s[:, None]
    turn = np.stack([bird.turn for bird in birds])[:, None]
    poses = np.stack([bird.pose for bird in birds])[:, None]
    found = describe(flock(result(poses, turn, place))).values
    return {name: values[:, 5] for name, values in found.items()}


def shown(name, value):
    """Return a label: the name of a feature, and its value in degrees."""
    return f"{name} {value[name]:.0f}°".replace("-", "−")


def draw_side(sheet):
    """Pitch of the body, angles of neck and head, elevation of the gaze."""
    raised = np.degrees(STANDING[BIRD.joint_names.index("head") - 1])
    bird = Bird(bent(STANDING, head=raised - [14, 0, 0]), turned(0, 50))
    value = {name: each[0] for name, each in values_of(bird).items()}
    view = View((1, 0, 0), (0, 0, 1), (205, 570), 1060)
    sheet.text((20, HEIGHT - 24), "Body, neck and head from the side", weight="bold", size=16)
    sheet.bird(bird, view)
    ground = view(bird.vertices)[:, 1].min()
    sheet.line((30, ground), (500, ground), colour=FAINT)
    # body
    root, pitch = view(bird.root), value["body_pitch"]
    sheet.line(root, beside(root, 235, 0), colour=BLUE, dashed=True)
    sheet.arrow(towards(root, pitch + 180, 100), towards(root, pitch, 200), BLUE)
    sheet.arc(root, 130, 0, pitch, BLUE)
    sheet.text(towards(root, pitch / 2, 140), shown("body_pitch", value), BLUE)
    sheet.text((30, ground - 22), "blue: axes of the body", BLUE, size=12)
    # neck
    base, head = view(bird.joints["neck_root"]), view(bird.joints["head"])
    neck = view.angle(bird.joints["head"] - bird.joints["neck_root"])
    gaze, eyes, tip = view.angle(bird.gaze), view(bird.eyes), view(bird.keypoints["bill_tip"])
    corner = crossing(base, neck, eyes, gaze)
    sheet.line(base, towards(base, pitch, 85), colour=BLUE, dashed=True)
    sheet.line(base, corner, colour=ORANGE, width=2.2)
    sheet.arc(base, 62, pitch, neck, ORANGE)
    sheet.line(towards(base, neck - 10, 62), (130, base[1] + 62), colour=ORANGE, width=0.9)
    sheet.text((124, base[1] + 62), shown("neck_angle", value), ORANGE, align="right")
    sheet.dot(base, head, colour=ORANGE)
    # head
    sheet.line(corner, towards(corner, neck, 100), colour=ORANGE, dashed=True)
    sheet.line(corner, eyes, colour=PURPLE, width=2.2, dashed=True)
    sheet.arrow(eyes, towards(eyes, gaze, 165), PURPLE)
    sheet.arc(corner, 66, gaze, neck, PURPLE)
    sheet.text(towards(corner, 45, 76), shown("head_angle", value), PURPLE)
    sheet.dot(eyes, tip, colour=PURPLE)
    # gaze
    sheet.line(eyes, beside(eyes, 215, 0), colour=GREEN, dashed=True)
    sheet.arc(eyes, 135, gaze, 0, GREEN)
    sheet.text(towards(eyes, gaze / 2, 145), shown("gaze_elevation", value), GREEN)


def draw_wings(sheet):
    """Roll of the body and elevation of the wings, from behind."""
    up, down = (np.asarray(POSTURES[f"wings_{way}"].body_pose) for way in ("up", "down"))
    bird = Bird(0.8 * up + 0.2 * down, turned(90, 0, 14))
    value = {name: each[0] for name, each in values_of(bird).items()}
    view = View((1, 0, 0), (0, 0, 1), (775, 735), 530)
    sheet.text((590, HEIGHT - 24), "Body and wings from behind", weight="bold", size=16)
    sheet.bird(bird, view)
    right = view.angle(bird.turn[:, 0])
    for side, plane in (("left", right + 180), ("right", right)):
        shoulder, tip = view(bird.joints[f"{side}_shoulder"]), view(bird.keypoints[f"{side}_wingtip"])
        wing = view.angle(bird.keypoints[f"{side}_wingtip"] - bird.joints[f"{side}_shoulder"])
        sheet.line(shoulder, towards(shoulder, plane, 150), colour=BLUE, dashed=True)
        sheet.line(shoulder, tip, colour=ORANGE, width=2.2)
        sheet.arc(shoulder, 110, wing, plane, ORANGE)
        sheet.dot(shoulder, tip, colour=ORANGE)
    sheet.text(beside(tip, 6, 20), shown("wing_elevation", value), ORANGE, align="right")
    root = view(bird.root)
    sheet.line(root, beside(root, 165, 0), colour=PURPLE, dashed=True)
    sheet.line(root, towards(root, right, 165), colour=BLUE, width=2.2)
    sheet.arc(root, 150, 0, right, PURPLE)
    sheet.text(beside(root, 60, -46), shown("body_roll", value), PURPLE)
    sheet.dot(root, colour=BLUE)


def draw_spread(sheet):
    """Spread of the wings, from above."""
    bird = Bird(np.asarray(POSTURES["wings_half"].body_pose), turned(90))
    spread = values_of(bird)["wing_spread"][0]
    view = View((1, 0, 0), (0, 1, 0), (705, 495), 540)
    sheet.text((590, 625), "Wings from above", weight="bold", size=16)
    sheet.bird(bird, view)
    bones = [view(bird.keypoints["left_wingtip"])]
    bones += [view(bird.joints[f"left_{bone}"]) for bone in ("wrist", "elbow", "shoulder")]
    bones += [view(bird.joints[f"right_{bone}"]) for bone in ("shoulder", "elbow", "wrist")]
    bones.append(view(bird.keypoints["right_wingtip"]))
    sheet.line(*bones, colour=ORANGE, width=2.2)
    sheet.dot(*bones, colour=ORANGE, size=4)
    sheet.arrow(bones[0], bones[-1], RED, both=True)
    sheet.text((828, 515), f"wing_spread {spread:.2f} =")
    sheet.text((828, 493), "distance of the wingtips", RED)
    sheet.text((828, 471), "÷ length of the line", ORANGE)
    sheet.text((828, 449), "   along the bones", ORANGE)


def draw_two(sheet):
    """Headings, and what relates a bird to its neighbour, from above."""
    sheet.text((20, 372), "Two birds from above", weight="bold", size=16)
    view = View((1, 0, 0), (0, 1, 0), (190, 120), 800)
    first = Bird(bent(STANDING, neck=[-20, 0, 25], head=[-30, 0, 30]), turned(42, 50))
    second = Bird(STANDING, turned(190, 50), (0.76, 0.1, 0))
    move = 0.22 * np.array([np.cos(np.radians(222)), np.sin(np.radians(222)), 0])  # in one second
    found = values_of(first, second, moved_m=[np.zeros(3), move])
    value = {name: each[0] for name, each in found.items()}
    for bird in (first, second):
        sheet.bird(bird, view)
    here, there = view(first.root), view(second.root)
    heading, line = value["body_heading"], view.angle(second.root - first.root)
    # the neighbour
    sheet.line(here, there, colour=TEAL, width=2.2)
    sheet.dot(here, there, colour=TEAL)
    middle = 0.42 * here + 0.58 * there + [0, -17]
    words = f"neighbour_distance {value['neighbour_distance']:.2f} m"
    sheet.text(middle, words, TEAL, align="center", rotation=line)
    bills = [view(bird.keypoints["bill_tip"]) for bird in (first, second)]
    sheet.arrow(*bills, GREEN, both=True)
    slope = view.angle(second.keypoints["bill_tip"] - first.keypoints["bill_tip"])
    middle, words = 0.4 * bills[0] + 0.6 * bills[1] + [0, 15], f"bill_distance {value['bill_distance']:.2f} m"
    sheet.text(middle, words, GREEN, align="center", rotation=slope)
    # directions of the first bird
    sheet.line(here, beside(here, 262, 0), colour=FAINT, dashed=True)
    sheet.text(beside(here, 269, 0), "x axis of the world", FAINT)
    sheet.arrow(here, towards(here, heading, 255), BLUE)
    sheet.arc(here, 220, 0, heading, BLUE)
    sheet.text(beside(here, 217, -18), shown("body_heading", value), BLUE)
    sheet.arc(here, 95, line, heading, ORANGE)
    sheet.text(towards(here, (line + heading) / 2, 104), shown("facing_angle", value), ORANGE)
    eyes, gaze = view(first.eyes), view.angle(first.gaze)
    sheet.line(eyes, towards(eyes, heading, 110), colour=BLUE, dashed=True)
    sheet.arrow(eyes, towards(eyes, gaze, 130), PURPLE)
    sheet.arc(eyes, 85, heading, gaze, PURPLE)
    sheet.text(towards(eyes, (heading + gaze) / 2, 94), shown("gaze_turn", value), PURPLE)
    # movement of the second bird
    moved, speed = view(second.root + move), found["approach_speed"][1]
    along = towards(there, line + 180, speed * view.scale)
    sheet.arrow(there, moved, INK)
    sheet.line(moved, along, colour=INK, width=1.2, dashed=True)
    sheet.arrow(there, along, RED, width=3.2)
    sheet.text(beside(moved, 8, -14), "movement in 1 s", INK)
    sheet.line(0.5 * (there + along), beside(along, 40, 66), colour=RED, width=0.9)
    sheet.text(beside(along, 40, 76), f"approach_speed {speed:.2f} m/s", RED, align="center")


def draw():
    """Return the drawing."""
    sheet = Sheet()
    for part in (draw_side, draw_wings, draw_spread, draw_two):
        part(sheet)
    return sheet.figure


def main(path):
    """Write the drawing, the same bytes in every run."""
    with rc_context({"svg.hashsalt": "jaxfit", "svg.fonttype": "path", "font.family": "DejaVu Sans"}):
        draw().savefig(path, metadata={"Date": None, "Creator": None} if Path(path).suffix == ".svg" else None)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else FILE)
