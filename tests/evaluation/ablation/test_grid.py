"""Grids of runs: crossed in order, named, and refused where they make no sense."""

import pytest
from support.cli_files import CONFIG

from jaxfit.evaluation.ablation.grid import GRID_RUNS, load_grid, require_runs
from jaxfit.evaluation.ablation.measure import pairs_of
from jaxfit.fitting.solve import compiled_part
from jaxfit.foundation.errors import InputError


def grid_file(folder, text):
    (folder / "fit.yaml").write_text(CONFIG)
    path = folder / "grid.yaml"
    path.write_text(f"config: {folder / 'fit.yaml'}\n{text}")
    return path


def test_the_shipped_grid_is_the_papers():
    runs = load_grid("ablation")[0]
    assert len(runs) == 34
    single = [run.config for run in runs if run.config.window == 1]
    assert sorted(config.filter_window for config in single) == [1, 5]
    assert all(config.terms["velocity"] == config.terms["acceleration"] == 0 for config in single)
    assert not any(config.common_size for config in single)
    points = set()
    for config in (run.config for run in runs if run.config.window == 100):
        velocity, acceleration = config.terms["velocity"], config.terms["acceleration"]
        assert acceleration in (0, velocity)
        points.add((velocity, acceleration > 0, config.filter_window, config.common_size))
    assert points == {(v, a, f, c) for v in (1e2, 1e3, 1e4, 1e5) for a in (0, 1) for f in (1, 5) for c in (0, 1)}
    # what needs another program: the window, and one scale or many
    assert len({repr(compiled_part(run.config)) for run in runs}) == 3


def test_the_shipped_claims_find_their_pairs():
    runs, claims = load_grid("ablation")
    counts = [len(pairs_of(claim, runs)) for claim in claims]
    assert counts == [2, 17, 1, 16, 1, 16, 1, 8, 8]


def test_the_last_key_changes_fastest_and_runs_are_named(tmp_path):
    text = "crosses:\n  - set: {common_size: false}\n    cross: {filter_window: [1, 3], terms.velocity: [1, 1.0e+4]}"
    runs = load_grid(grid_file(tmp_path, text))[0]
    assert [run.name for run in runs] == [
        "1_filter_window=1,velocity=1",
        "2_filter_window=1,velocity=10000",
        "3_filter_window=3,velocity=1",
        "4_filter_window=3,velocity=10000",
    ]
    assert [dict(run.levels) for run in runs][1] == {"filter_window": 1, "terms.velocity": 1e4}
    assert not any(run.config.common_size for run in runs)


def test_a_key_that_a_cross_leaves_alone_has_the_bases_level(tmp_path):
    text = "crosses:\n  - cross: {terms.velocity: [1, 2]}\n  - cross: {window: [3]}"
    runs = load_grid(grid_file(tmp_path, text))[0]
    assert [dict(run.levels) for run in runs] == [
        {"terms.velocity": 1, "window": 6},
        {"terms.velocity": 2, "window": 6},
        {"terms.velocity": 0.1, "window": 3},
    ]


def test_equal_runs_are_one(tmp_path, caplog):
    text = "crosses:\n  - cross: {terms.velocity: [0, 2], terms.keypoints: [6.25, =terms.velocity]}\n"
    text += "  - cross: {terms.velocity: [2]}"
    assert len(load_grid(grid_file(tmp_path, text))[0]) == 4
    assert "one run is kept" in caplog.text


def test_the_runs_of_a_config_that_learns_weights_learn_none(tmp_path, caplog):
    (tmp_path / "fit.yaml").write_text("base: photo")
    (tmp_path / "grid.yaml").write_text(
        f"config: {tmp_path / 'fit.yaml'}\ncrosses: [{{cross: {{terms.pose_prior: [1, 2]}}}}]"
    )
    assert not any(run.config.learn_weights for run in load_grid(tmp_path / "grid.yaml")[0])
    assert "learn no weights" in caplog.text
    # what is learnt with the bodies belongs to every run
    (tmp_path / "fit.yaml").write_text("base: map")
    assert all(run.config.learn_weights for run in load_grid(tmp_path / "grid.yaml")[0])


def test_the_number_of_runs_is_checked_before_the_runs_are_made(tmp_path):
    for cross in (
        ", ".join(f"{path}: [{', '.join('1' * 1000)}]" for path in "abcd"),
        f"a: [{', '.join('1' * (GRID_RUNS + 1))}]",
    ):
        with pytest.raises(InputError, match=r"line 2: `crosses` makes (1,000,000,000,000|10,001) runs .*10,000"):
            load_grid(grid_file(tmp_path, f"crosses: [{{cross: {{{cross}}}}}]"))
    with pytest.raises(InputError, match=r"makes more than 10\^15 runs"):
        require_runs("values", [[range(10_000)] * 500])


def test_names_of_runs_are_ascii_and_short(tmp_path):
    text = f"crosses:\n  - cross: {{'stages[0].name': ['{'é' * 300}', '../a|b']}}"
    names = [run.name for run in load_grid(grid_file(tmp_path, text))[0]]
    assert all(len(name.encode()) < 130 and "/" not in name for name in names)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("crosses: []", ("crosses", "empty")),
        ("crosses:\n  - cross: {}", ("crosses[0].cross", "empty")),
        ("crosses:\n  - cross: {window: []}", ("crosses[0].cross.window", "no run")),
        ("crosses:\n  - cross: {window: 5}", ("crosses[0].cross.window", "list")),
        ("crosses:\n  - cross: {windw: [1, 2]}", ("windw", "window")),
        ("crosses:\n  - cross: {window: [1, two]}", ("window", "two")),
        ("crosses:\n  - {cross: {window: [1]}, set: {window: 2}}", ("window", "set")),
        ("crosss:\n  - cross: {window: [1]}", ("crosss", "crosses")),
        (
            "crosses: [{cross: {window: [1, 2]}}]\nclaims: [{claim: x, better: {filter_window: 1}, worse: {}}]",
            ("claims[0]", "filter_window", "window"),
        ),
    ],
)
def test_what_is_no_grid(tmp_path, text, words):
    path = grid_file(tmp_path, text)
    with pytest.raises(InputError) as refusal:
        load_grid(path)
    for word in (str(path), *words):
        assert word in str(refusal.value)
