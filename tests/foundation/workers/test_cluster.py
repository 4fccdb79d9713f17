"""Workers of Dask: equal results, lost workers, failed tasks, other versions, and schedulers that do not answer."""

import os
import signal
import socket
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from support.cli_files import arguments, rejected
from support.fits import BIRD, CAMERA, T, config, truths
from support.worker_tasks import add, attempts, deadly, ending, failing, quick_fit, refusing

from jaxfit.cli.main import main
from jaxfit.fitting.fit import fit, fit_runs, windows_of
from jaxfit.fitting.stored_windows import StoredWindows
from jaxfit.fitting.tasks import FitTask
from jaxfit.fitting.windows import window_content
from jaxfit.foundation import workers as module
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.unfinished import Parts
from jaxfit.foundation.workers import Cluster, FailedTask, open_cluster
from jaxfit.model.kinematics import Pose
from jaxfit.simulation.noise import detect

distributed = pytest.importorskip("distributed")
ARRAYS = [*Pose.__dataclass_fields__, "keypoints_cam", "keypoints_px", "valid", "status"]
BIRDS = 3


def settings(**changes):
    return config(steps=(20, 2), memory_gb=1.0, **changes)


def observe():
    """Two windows for each of three toy birds."""
    return detect(BIRD, truths(2 * T, BIRDS), 1.0, 0.05, 0, masks=False, camera=CAMERA)


@pytest.fixture
def quick(monkeypatch):
    """Replace the solution of a task by poses that depend on the window and the config."""
    monkeypatch.setattr("jaxfit.fitting.tasks.fit_task", quick_fit)


def assert_equal(actual, expected):
    for name in ARRAYS:
        np.testing.assert_array_equal(actual.arrays()[name], expected.arrays()[name], err_msg=name)
    assert set(actual.loss) == set(expected.loss)
    for term, loss in expected.loss.items():
        np.testing.assert_array_equal(actual.loss[term], loss, err_msg=term)


@pytest.mark.usefixtures("quick")
def test_a_fit_on_workers_equals_a_fit_of_one_process(workers, tmp_path):
    observed, some = observe(), settings()
    expected = fit(observed, BIRD, some)
    stored = StoredWindows(Parts(tmp_path / "windows", {}))
    assert_equal(fit(observed, BIRD, some, cluster=workers, stored=stored), expected)
    parts = sorted((tmp_path / "windows").glob("*.npz"))
    assert len(parts) == BIRDS  # a task is a tile of two windows
    parts[1].unlink()
    sent = []

    class Counted(Cluster):
        def run(self, function, shared, tasks):
            tasks = list(tasks)
            sent.extend(tasks)
            return workers.run(function, shared, tasks)

    stored = StoredWindows(Parts(tmp_path / "windows", {}))
    assert_equal(fit(observed, BIRD, some, cluster=Counted(None, ""), stored=stored), expected)
    assert [len(task.problems) for task in sent] == [2]


@pytest.mark.parametrize("real", [False, pytest.param(True, marks=pytest.mark.extended)])
def test_several_runs_on_workers(workers, real, request):
    """The runs have other windows and other weights."""
    if not real:
        request.getfixturevalue("quick")
    observed = observe()
    runs = [settings(), settings(min_keypoints=5), replace(settings(), terms=settings().terms | {"pose_prior": 1.0})]
    for actual, expected in zip(
        fit_runs(observed, BIRD, runs, cluster=workers), fit_runs(observed, BIRD, runs), strict=True
    ):
        assert_equal(actual, expected)


@pytest.mark.usefixtures("quick")
def test_a_failed_task_is_a_status_of_its_birds(tmp_path, caplog):
    class OneFails(Cluster):
        def run(self, function, shared, tasks):
            for i, task in enumerate(tasks):
                yield i, FailedTask("3 workers ended during the task") if i == 0 else function(shared, task)

    observed, some = observe(), settings()
    stored = StoredWindows(Parts(tmp_path, {}))
    solution = fit(observed, BIRD, some, cluster=OneFails(None, ""), stored=stored)
    expected = fit(observed, BIRD, some)
    assert solution.status.tolist() == ["partly diverged", "partly diverged", "ok"]
    np.testing.assert_array_equal(solution.keypoints.px[solution.valid], expected.keypoints.px[solution.valid])
    assert solution.valid.sum() == expected.valid.sum() - 2 * T
    text = f"frames 0 to {T - 1}: not computed: 3 workers ended during the task"
    assert solution.failures == {0: (text,), 1: (text,)}
    assert "not computed" in caplog.text
    assert len(list(tmp_path.glob("*.npz"))) == BIRDS - 1  # the failed windows are computed again after a restart


def test_runs_that_share_windows_share_the_rows_of_a_task():
    """Run 0 and run 1 have equal windows, and the task holds other windows of run 0 than of run 1."""
    configs = [settings(), replace(settings(), terms=settings().terms | {"pose_prior": 1.0}), settings(min_keypoints=5)]
    observed = observe()
    windows = [windows_of(observed, each, "observations") for each in configs]
    problems = [(0, 0), (0, 4), (1, 3), (2, 5)]
    task = FitTask(configs, windows, problems).part(problems)
    for (r, w), (same, row) in zip(problems, task.problems, strict=True):
        assert r == same
        assert window_content(task.windows[r], row) == window_content(windows[r], w)
    assert task.problems == [(0, 0), (0, 2), (1, 1), (2, 0)]
    assert [len(some) for some in task.windows] == [3, 3, 1]
    np.testing.assert_array_equal(task.windows[0].keypoints_px, task.windows[1].keypoints_px)


def test_tasks_are_taken_as_they_are_needed(workers):
    taken = []

    def tasks():
        for i in range(40):
            taken.append(i)
            yield i

    running = workers.run(add, 100, tasks())
    next(running)
    assert len(taken) <= 2 * module.TASKS_PER_THREAD + 1
    assert sorted(running)[-1] == (39, 139)


def test_a_task_is_repeated_and_then_fails(workers):
    attempts.clear()
    results = dict(workers.run(failing, {1: 2, 2: 9}, range(4)))
    assert results[2] == FailedTask("failed 3 times on the workers: RuntimeError: task 2")
    assert {i: results[i] for i in (0, 1, 3)} == {0: 0, 1: 1, 3: 3}
    assert [attempts.count(i) for i in range(4)] == [1, 3, 3, 1]


def test_a_run_without_any_result_is_an_error(inputs, scheduler, workers, tmp_path, monkeypatch, capsys):
    """The command ends with an exit code, and without a result of no poses."""
    attempts.clear()
    running = workers.run(failing, {1: 9}, [1])
    assert next(running) == (0, FailedTask("failed 3 times on the workers: RuntimeError: task 1"))
    with pytest.raises(InputError, match="no task could be computed: failed 3 times on the workers: RuntimeError: t"):
        next(running)
    monkeypatch.setattr("jaxfit.fitting.tasks.fit_task", ending)
    options = [*arguments(inputs, tmp_path / "out"), "--scheduler", scheduler]
    rejected(capsys, options, "no task could be computed")
    assert list(tmp_path.iterdir()) == []


def test_an_input_error_of_a_task_ends_the_run(workers):
    with pytest.raises(InputError, match="term 'far': cannot be imported"):
        list(workers.run(refusing, None, range(3)))


def test_other_versions_are_refused(scheduler, workers, monkeypatch):
    own = module._versions()
    versions = iter([own | {"jaxfit": "9"}, *[own] * 99])
    monkeypatch.setattr(module, "_versions", lambda: next(versions))
    with pytest.raises(InputError, match=r"worker tcp.*: has jaxfit .* instead of 9 \(install the same packages"):
        list(workers.run(add, 1, [2]))
    versions = iter([own | {"distributed": "1.0"}] * 2)
    with (
        pytest.raises(InputError, match=r"^--scheduler .*: has distributed .* instead of 1\.0"),
        open_cluster(scheduler=scheduler),
    ):
        pass
    with pytest.raises(InputError, match="worker a: cannot use jaxfit: ModuleNotFoundError: No module named 'jaxfit'"):
        module._check_versions("worker a", ModuleNotFoundError("No module named 'jaxfit'"), own)


def test_no_scheduler_answers(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "CONNECT_S", 0.3)

    def refused(address, words):
        with pytest.raises(InputError, match=words), open_cluster(scheduler=str(address)):
            pass

    refused("nowhere", "--scheduler nowhere: is not a scheduler: missing port number")
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        refused(f"127.0.0.1:{silent.getsockname()[1]}", "is not a scheduler: (Timed out|no answer)")
        silent.listen()
        refused(f"127.0.0.1:{silent.getsockname()[1]}", "is not a scheduler: no answer within 0.3 s")
    refused(tmp_path / "absent.json", "absent.json: does not exist")
    (tmp_path / "list.json").write_text("[]")
    refused(tmp_path / "list.json", "list.json: is not a scheduler")


def test_the_command(inputs, scheduler, tmp_path, monkeypatch, capsys):
    """A scheduler that is not there is refused, and the files of a result on workers are those of one process."""
    monkeypatch.setattr("jaxfit.fitting.tasks.fit_task", quick_fit)
    options = arguments(inputs, tmp_path / "out")
    rejected(capsys, [*options, "--scheduler", "nowhere"], "--scheduler nowhere: is not a scheduler")
    with pytest.raises(SystemExit):
        main([*options, "--scheduler", scheduler, "--workers", "2"])
    assert "not allowed with argument --scheduler" in capsys.readouterr().err
    assert main([*options, "--scheduler", scheduler]) == 0
    assert main([*options[:-1], str(tmp_path / "alone")]) == 0
    names = "poses.npz", "config.yaml", "model.npz"
    assert [(tmp_path / "out" / name).read_bytes() for name in names] == [
        (tmp_path / "alone" / name).read_bytes() for name in names
    ]


def test_a_scheduler_file(scheduler, tmp_path):
    (tmp_path / "scheduler.json").write_text(f'{{"address": "{scheduler}"}}')
    with open_cluster(scheduler=str(tmp_path / "scheduler.json")) as cluster:
        assert list(cluster.run(add, 1, [2])) == [(0, 3)]


def test_the_number_of_workers():
    with pytest.raises(InputError, match="--workers: is 0"), open_cluster(workers=0):
        pass
    with open_cluster() as cluster:
        assert cluster is None


def test_cores_are_shared():
    from jaxfit.foundation.worker_cores import share_of_cores

    assert [share_of_cores([0, 2, 4, 6, 7], i, 2) for i in range(2)] == [[0, 2], [4, 6, 7]]
    assert [share_of_cores([3, 5], i, 3) for i in range(3)] == [[3], [5], [3]]
    assert share_of_cores([], 0, 2) == []


@pytest.mark.extended
def test_two_processes_of_which_one_is_killed():
    """The worker is killed after the first result, while it computes its next task."""
    observed, some = detect(BIRD, truths(8 * T, BIRDS), 1.0, 0.05, 0, camera=CAMERA), settings()
    killed = []

    with open_cluster(workers=2) as cluster:

        @contextmanager
        def kill_one(_name, _total):
            def report(done, _note):
                if done and not killed:
                    killed.extend(cluster._connect().run(os.getpid).values())
                    os.kill(killed[0], signal.SIGKILL)

            yield report

        solution = fit(observed, BIRD, some, progress=kill_one, cluster=cluster)
        cores = cluster._connect().run(os.sched_getaffinity, 0)
    assert len(set(killed)) == 2
    assert_equal(solution, fit(observed, BIRD, some))
    shares = list(map(tuple, cores.values()))
    assert len(os.sched_getaffinity(0)) < 2 or len(set(shares)) == len(shares)


@pytest.mark.extended
def test_workers_that_end_with_results_that_were_not_taken():
    """All tasks are finished, and their results are in the workers, when both workers are killed."""
    with open_cluster(workers=2) as cluster:
        running = cluster.run(add, 100, range(6))
        results = [next(running)]
        client = cluster._connect()
        with client.as_current():
            distributed.wait([distributed.Future(key, client) for key in client.futures])
        killed = set(client.run(os.getpid).values())
        for process in killed:
            os.kill(process, signal.SIGKILL)
        while len(set(client.run(os.getpid, on_error="ignore").values()) - killed) < 2:
            time.sleep(0.1)
        results.extend(running)
    assert sorted(results) == [(i, 100 + i) for i in range(6)]


@pytest.mark.extended
def test_a_task_that_ends_three_workers(tmp_path):
    with open_cluster(workers=2) as cluster:
        results = dict(cluster.run(deadly, str(tmp_path), range(5)))
    assert results == {0: FailedTask("3 workers ended during the task"), 1: 1, 2: 2, 3: 3, 4: 4}
    assert (tmp_path / "once").exists()


@pytest.mark.extended
def test_a_scheduler_that_ends():
    options = {"processes": True, "n_workers": 1, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
    with (
        distributed.LocalCluster(host="127.0.0.1", **options) as local,
        open_cluster(scheduler=local.scheduler_address) as cluster,
    ):
        results = cluster.run(add, 1, range(50))
        next(results)
        local.close()
        with pytest.raises(InputError, match="the connection to the scheduler is lost"):
            list(results)
