"""The tables of `jaxfit bench`: every value with its unit, and nothing of Python's own notation."""

import json

from jaxfit.cli.main import main
from jaxfit.evaluation.benchmarks import fit, raster

SILHOUETTE = {
    "frames": 100,
    "faces": 5712,
    "ms_per_frame": 0.75,
    "isa": None,
    "gradient_error": 2.5e-6,
    "scaling": [
        {"frames": 25, "faces": 5712, "ms_per_frame": 0.8},
        {"frames": 100, "faces": 1428, "ms_per_frame": 0.251},
    ],
}
SOLVERS = {
    "stage": "keypoints",
    "adam": {"steps": [0, 25], "loss": [9.0, 1.0]},
    "adam_s": 1.5,
    "adam_loss": 112840.4,
    "levenberg_marquardt_s": None,
    "levenberg_marquardt_ratio": 0.25,
}


def rows(text):
    """Return the cells of the rows of all tables."""
    lines = [line.replace("┃", "│") for line in text.splitlines() if "│" in line or "┃" in line]
    return [[cell.strip() for cell in line.strip("│").split("│")] for line in lines]


def test_values_and_lists_of_measurements_have_units(monkeypatch, capsys):
    monkeypatch.setattr(raster, "bench_silhouette", lambda **_: SILHOUETTE)
    assert main(["bench", "silhouette"]) == 0
    said = capsys.readouterr().out
    assert "{" not in said
    shown = rows(said)
    assert ["loss and gradient", "0.75", "ms/frame"] in shown
    assert ["faces of the mesh", "5,712", ""] in shown
    assert ["relative error of the gradient", "2.5e-06", "1"] in shown
    headings = ["frames", "faces of the mesh", "loss and gradient, ms/frame"]
    assert shown[-3:] == [headings, ["25", "5,712", "0.8"], ["100", "1,428", "0.251"]]
    assert main(["bench", "silhouette", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == SILHOUETTE


def test_solvers_have_names_and_no_curves(monkeypatch, capsys):
    monkeypatch.setattr(fit, "bench_solvers", lambda *_, **__: SOLVERS)
    monkeypatch.setattr(fit, "noisy_scene", lambda *_: (None, None))
    assert main(["bench", "solvers"]) == 0
    said = capsys.readouterr().out
    assert "{" not in said
    shown = rows(said)
    assert ["final loss, adam", "112,840", "1"] in shown
    assert ["time until the final loss of adam, levenberg-marquardt", "–", "s"] in shown
