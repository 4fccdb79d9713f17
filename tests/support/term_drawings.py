"""Draw what each term of the objective measures, and how each stage works, for the documents.

`PYTHONPATH=tests .venv/bin/python -m support.term_drawings` writes `docs/media/terms/*.svg` and
`docs/media/method/*.svg`. Costs are computed by the kernels of the terms.
"""

from pathlib import Path

import matplotlib as mpl
import numpy as np

from jaxfit.fitting.windows import weighted_median_filter
from jaxfit.objective.residuals import RobustKernel, geman_mcclure, huber, student_t

mpl.use("svg")
import matplotlib.pyplot as plt

MEDIA = Path(__file__).resolve().parents[2] / "docs" / "media"
STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "jaxfit",
    "font.size": 9,
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": mpl.cycler(color=["#00695c", "#c2500a", "#5c6bc0", "#777777"]),
    "figure.constrained_layout.use": True,
}
LINE = "#777777"


def _axes(x="", y="", width=3.6, height=2.1):
    figure, axes = plt.subplots(figsize=(width, height))
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    return figure, axes


def _cost(kernel: RobustKernel, residual):
    return np.asarray(kernel.value(np.asarray(residual, np.float32) ** 2))


def _compared(axes, value, cost, name, other, other_name):
    """Plot the cost of a term, and another cost as a dashed line."""
    axes.plot(value, cost, label=name)
    axes.plot(value, other, "--", label=other_name, color=LINE)
    axes.legend(frameon=False)


def keypoints():
    figure, axes = _axes("error, pixels of a 256-pixel crop", "cost")
    error = np.linspace(-200, 200, 121)
    _compared(axes, error, _cost(geman_mcclure(50.0), error), "σ = 50", np.minimum(error**2, 3000), "square")
    axes.set_ylim(0, 3000)
    return figure


def keypoint_likelihood():
    figure, axes = _axes("error, pixels of a 256-pixel crop", "cost, nats")
    error = np.linspace(-30, 30, 121)
    for confidence in (1.0, 0.5, 0.1):
        scale = 1.2**confidence * 6 ** (1 - confidence)
        axes.plot(error, _cost(student_t(4.0, 2), error / scale), label=f"confidence {confidence:g}")
    axes.set_ylim(0, 24)
    axes.legend(frameon=False, fontsize=8)
    return figure


def mask():
    figure, (left, right) = plt.subplots(1, 2, figsize=(3.6, 2.1))
    y, x = np.mgrid[-1:1:48j, -1.3:1.3:62j]

    def bird(turn, length):
        c, s = np.cos(turn), np.sin(turn)
        distance = np.hypot((c * x + s * y) / length, (c * y - s * x) / 0.42) - 1
        return 1 / (1 + np.exp(np.clip(distance * 25, -60, 60)))

    silhouette, target = bird(0.25, 0.95), bird(-0.1, 1.0) > 0.5
    left.imshow(silhouette, cmap="Greys", vmin=0, vmax=1.4)
    left.contour(target, [0.5], colors="#c2500a", linewidths=1.2)
    left.set_title("silhouette, outline of the mask", fontsize=8)
    right.imshow(abs(silhouette - target), cmap="Oranges")
    right.set_title("|silhouette − mask|", fontsize=8)
    for axes in (left, right):
        axes.set_axis_off()
    return figure


def mask_smooth_l1():
    figure, axes = _axes("silhouette − mask, one pixel", "cost")
    difference = np.linspace(-1, 1, 101)
    _compared(axes, difference, difference**2 / 2, "mask_smooth_l1", abs(difference), "mask")
    return figure


def pose_prior():
    figure, axes = _axes("angle of one joint, rad", "angle of another joint")
    a, b = np.meshgrid(np.linspace(-1.2, 1.2, 50), np.linspace(-0.8, 0.8, 50))
    precision = np.linalg.inv([[0.16, 0.07], [0.07, 0.06]])
    cost = precision[0, 0] * a * a + 2 * precision[0, 1] * a * b + precision[1, 1] * b * b
    contours = axes.contour(a, b, cost, [1, 4, 9, 16], colors="#00695c")
    axes.clabel(contours, fontsize=7)
    axes.plot(0, 0, "+", color="#c2500a")
    axes.annotate("mean μ", (0, 0), (0.06, 0.04), color="#c2500a")
    return figure


def _parabola(x, y, mark, label):
    figure, axes = _axes(x, y)
    value = np.linspace(-3, 3, 61)
    axes.plot(value, value**2)
    axes.axvspan(-1, 1, color="#00695c", alpha=0.12)
    axes.set_xticks([-1, 0, 1], mark)
    axes.annotate(label, (0, 6), ha="center", color=LINE)
    return figure


def bone_prior():
    return _parabola("length of a bone", "cost", ["μ − sd", "μ", "μ + sd"], "68 % of the birds")


def shape_prior():
    return _parabola("shape coefficient β", "cost", ["−sd", "0", "sd"], "68 % of the birds")


def size_prior():
    figure, axes = _axes("size ÷ size of the species", "cost")
    size = np.linspace(0.8, 1.25, 91)
    axes.plot(size, (np.log(size) / 0.05) ** 2)
    axes.axvspan(np.exp(-0.05), np.exp(0.05), color="#00695c", alpha=0.12)
    return figure


def shape_norm():
    figure, axes = _axes("shape coefficient β", "cost")
    value = np.linspace(-3, 3, 61)
    _compared(axes, value, abs(value), "shape_norm", value**2, "shape_prior")
    axes.set_ylim(0, 5)
    return figure


def stage_anchor():
    figure, axes = _axes("angle of a joint, rad", "cost")
    value = np.linspace(-1, 1, 61)
    axes.plot(value, abs(value - 0.2))
    axes.set_xticks([-1, 0.2, 1], ["−1", "start of the stage", "1"])
    return figure


def _trace():
    rng = np.random.default_rng(3)
    frames = np.arange(13)
    return frames, 0.4 * np.sin(frames / 3) + rng.normal(0, 0.06, len(frames))


def velocity():
    figure, axes = _axes("frame", "angle, rad")
    frames, angle = _trace()
    axes.plot(frames, angle, "o", markersize=3)
    for i in range(len(angle) - 1):
        axes.plot([i + 1, i + 1], [angle[i], angle[i + 1]], color="#c2500a", linewidth=2)
        axes.plot([i, i + 1], [angle[i], angle[i]], color=LINE, linewidth=0.6)
    axes.set_title("cost: total length of the orange bars", fontsize=8)
    return figure


def acceleration():
    figure, axes = _axes("frame", "angle, rad")
    frames, angle = _trace()
    axes.plot(frames, angle, "o", markersize=3)
    for i in range(len(angle) - 2):
        expected = 2 * angle[i + 1] - angle[i]
        axes.plot([i + 1, i + 2], [angle[i + 1], expected], color=LINE, linewidth=0.6)
        axes.plot([i + 2, i + 2], [expected, angle[i + 2]], color="#c2500a", linewidth=2)
    axes.set_title("cost: distances from a steady motion", fontsize=8)
    return figure


def geodesic_velocity():
    figure, axes = _axes("turn between two frames, degrees", "cost, rad")
    turn = np.linspace(0, 360, 121)
    axes.plot(turn, np.radians(np.minimum(turn, 360 - turn)), label="geodesic_velocity")
    axes.plot(turn, np.radians(turn), "--", color=LINE, label="velocity")
    axes.set_xticks([0, 90, 180, 270, 360])
    axes.legend(frameon=False)
    return figure


def huber_velocity():
    figure, axes = _axes("rotation of a joint, rad a frame", "cost")
    turn = np.linspace(-0.5, 0.5, 101)
    axes.plot(turn, _cost(huber(0.1), turn), label="δ = 0.1")
    axes.plot(turn, turn**2 / 2, "--", color=LINE, label="square")
    axes.set_ylim(0, 0.06)
    axes.legend(frameon=False)
    return figure


def low_pass():
    figure, axes = _axes("frequency, cycles a frame", "weight")
    frequency = np.linspace(0.005, 0.5, 100)
    axes.plot(frequency, 1 / (1 + (0.15 / frequency) ** 8))
    axes.axvline(0.15, color=LINE, linestyle="--", linewidth=0.8)
    axes.annotate("cut-off", (0.16, 0.05), color=LINE)
    return figure


def _heavy_tails(x, scale, size):
    figure, axes = _axes(x, "cost, nats")
    value = np.linspace(-12, 12, 121)
    axes.plot(value * scale, _cost(student_t(1.0, size), value), label="ν = 1")
    axes.plot(value * scale, np.minimum(value**2 / 2, 30), "--", color=LINE, label="Gaussian")
    axes.set_ylim(0, 12)
    axes.locator_params("x", nbins=5)
    axes.legend(frameon=False)
    return figure


def motion_likelihood():
    return _heavy_tails("angular acceleration, rad/s²", 6.25, 3)


def place_likelihood():
    return _heavy_tails("acceleration of the place, pixels/s²", 300, 2)


def joint_limits():
    figure, axes = _axes("angle of a joint, rad", "cost, rad²")
    angle = np.linspace(-1.5, 1.5, 121)
    axes.plot(angle, np.maximum(-0.8 - angle, 0) ** 2 + np.maximum(angle - 0.6, 0) ** 2)
    axes.axvspan(-0.8, 0.6, color="#00695c", alpha=0.12)
    axes.set_xticks([-0.8, 0.6], ["lower limit", "upper limit"])
    return figure


def feet_on_ground():
    figure, axes = _axes("motion of a foot, model units a frame", "cost")
    motion = np.linspace(0, 5, 101)
    axes.plot(motion, _cost(geman_mcclure(0.5), motion))
    axes.annotate("standing: pulled to 0", (0.45, 0.04), color=LINE, fontsize=8)
    axes.annotate("walking, flying: free", (2.2, 0.21), color=LINE, fontsize=8)
    return figure


TERMS = (
    *(keypoints, keypoint_likelihood, mask, mask_smooth_l1, pose_prior, bone_prior, size_prior, shape_prior),
    *(shape_norm, stage_anchor, velocity, acceleration, geodesic_velocity, huber_velocity, low_pass),
    *(motion_likelihood, place_likelihood, joint_limits, feet_on_ground),
)
"""One drawing for every term of the library, of the same name."""


def detection():
    figure, axes = _axes(width=5.2, height=2.2)
    y, x = np.mgrid[0:11, 0:26]
    for centre_x, centre_y, colour in ((8, 5.5, "#00695c"), (17.5, 4.5, "#c2500a")):
        inside = ((x - centre_x) / 6.2) ** 2 + ((y - centre_y) / 3.4) ** 2 < 1
        inside &= (x < 13) == (centre_x < 13)
        axes.quiver(
            *(x[inside], y[inside], centre_x - x[inside], centre_y - y[inside]),
            **{"color": colour, "angles": "xy", "scale_units": "xy", "scale": 2.2, "width": 0.003},
        )
        axes.plot(centre_x, centre_y, "o", color=colour)
    axes.set_axis_off()
    axes.set_title("cells of the foreground, their offsets, and the centres of two birds", fontsize=8)
    return figure


def tracking():
    figure, axes = _axes(width=5.2, height=2.0)
    tracks = ((0.3, 0.5, "track 1"), (2.1, 0.9, "track 2"))
    birds = ((0.55, 0.65), (2.3, 0.8), (4.2, 0.6))
    for x, y, name in tracks:
        axes.add_patch(mpl.patches.Rectangle((x, y), 1.4, 1.0, fill=False, linestyle="--", edgecolor=LINE))
        axes.annotate(name, (x, y - 0.16), color=LINE, fontsize=8)
    for x, y in birds:
        overlaps = [max(1.4 - abs(x - left), 0) * max(1 - abs(y - top), 0) for left, top, _ in tracks]
        iou = max(overlap / (2.8 - overlap) for overlap in overlaps)
        axes.add_patch(mpl.patches.Rectangle((x, y), 1.4, 1.0, fill=False, edgecolor="#00695c"))
        axes.annotate(f"IoU {iou:.2f}" if iou else "new track", (x + 0.4, y + 0.45), color="#00695c", fontsize=8)
    axes.set_xlim(0, 6)
    axes.set_ylim(0.2, 2.1)
    axes.set_axis_off()
    axes.set_title("last boxes of the tracks (dashed), boxes of the next frame, and their overlap", fontsize=8)
    return figure


def keypoint_heatmap():
    figure, (left, right) = plt.subplots(1, 2, figsize=(5.2, 2.1), width_ratios=(1, 1.6))
    y, x = np.mgrid[0:16, 0:16]
    left.imshow(np.exp(-((x - 9.3) ** 2 + (y - 6.8) ** 2) / 6), cmap="Greens")
    left.plot(9.3, 6.8, "+", color="#c2500a")
    left.set_axis_off()
    left.set_title("heatmap of one keypoint", fontsize=8)
    cells = np.arange(4, 16)
    right.bar(cells, np.exp(-((cells - 9.3) ** 2) / 6), color="#80a89f")
    right.axvline(9.3, color="#c2500a")
    right.set_xlabel("cell")
    right.set_title("the peak, between cells", fontsize=8)
    return figure


def windows():
    figure, axes = _axes("frame", "x of a keypoint, pixels", 5.2, 2.2)
    rng = np.random.default_rng(1)
    frames = np.arange(120)
    detected = 40 + 10 * np.sin(frames / 16) + rng.normal(0, 1.2, len(frames))
    detected[[17, 44, 45, 81, 103]] += [22, -18, -20, 25, -21]
    points = np.stack([detected, detected], -1)[:, None].astype(np.float32)
    filtered = np.asarray(weighted_median_filter(points, np.ones((len(frames), 1), np.float32), 5))[:, 0, 0]
    axes.plot(frames, detected, ".", color="#c2500a", markersize=4, label="detected")
    axes.plot(frames, filtered, label="median of 5 frames")
    for start, stop in ((0, 50), (40, 90), (80, 120)):
        axes.axvspan(start, stop, color="#00695c", alpha=0.09)
    axes.legend(frameon=False, ncols=2, fontsize=8)
    axes.set_title("windows (here of 50 frames) that share 10 frames", fontsize=8)
    return figure


def initial_poses():
    figure, axes = _axes("frame", "turn, degrees", 5.2, 2.3)
    frames, turns = np.arange(40), np.arange(0, 360, 12)
    truth = 150 + 1.5 * frames
    apart = np.abs((turns[:, None] - truth + 180) % 360 - 180)
    flipped = np.abs((turns[:, None] - truth - 180 + 180) % 360 - 180) + np.where(np.isin(frames, [9, 24, 25]), -40, 25)
    cost = np.minimum(apart, flipped)
    axes.imshow(cost, aspect="auto", origin="lower", extent=(-0.5, 39.5, -6, 354), cmap="Greens_r", vmin=-40, vmax=110)
    axes.plot(frames, turns[np.argmin(cost, 0)], ".", color="#c2500a", label="best turn of each frame")
    axes.plot(frames, truth, color="#222222", label="best sequence")
    axes.set_ylim(-60, 354)
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="lower right")
    return figure


def silhouette():
    figure, axes = _axes("distance from the outline of the mesh, pixels", "silhouette", 5.2, 2.2)
    distance = np.linspace(-7, 7, 141)
    s = 1e-4 * 128**2
    face = 1 / (1 + np.exp(-np.sign(-distance) * distance**2 / s))
    axes.plot(distance, 1 - (1 - face) ** 3, label="published edge, three faces at the outline")
    cumulative = np.cumsum(np.exp(-(distance**2) / (2 * 1.5**2)))
    axes.plot(distance, 1 - cumulative / cumulative[-1], label="unbiased edge")
    axes.axvline(0, color=LINE, linewidth=0.8)
    axes.legend(frameon=False, fontsize=8)
    return figure


def temporal():
    figure, axes = _axes("frame", "angle, rad", 5.2, 2.2)
    rng = np.random.default_rng(5)
    frames = np.arange(60)
    noisy = 0.5 * np.tanh((frames - 30) / 4) + rng.normal(0, 0.09, len(frames))
    axes.plot(frames, noisy, ".", color="#c2500a", markersize=4, label="single frames")
    for weight, style in ((0.3, "-"), (8.0, "--")):
        angle, steps = noisy.copy(), np.diff(np.eye(len(frames)), axis=0)
        for _ in range(200):  # iteratively reweighted least squares
            norm = np.maximum(abs(steps @ angle), 1e-4)
            angle = np.linalg.solve(np.eye(len(frames)) + weight / 2 * steps.T @ (steps / norm[:, None]), noisy)
        label = "velocity term" if weight < 1 else "weight too large"
        axes.plot(frames, angle, style, label=label)
    axes.legend(frameon=False, fontsize=8, ncols=3, loc="upper left")
    axes.set_ylim(-0.9, 1.2)
    return figure


METHOD = (detection, tracking, keypoint_heatmap, windows, initial_poses, silhouette, temporal)


def write():
    """Write all drawings."""
    for folder, drawings in (("terms", TERMS), ("method", METHOD)):
        (MEDIA / folder).mkdir(exist_ok=True)
        for drawing in drawings:
            with mpl.rc_context(STYLE):
                figure = drawing()
                figure.savefig(MEDIA / folder / f"{drawing.__name__}.svg", metadata={"Date": None, "Creator": None})
                plt.close(figure)


if __name__ == "__main__":
    write()
