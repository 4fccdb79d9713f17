"""Workers of Dask in this process."""

import pytest

from jaxfit.foundation.workers import open_cluster


@pytest.fixture(scope="module")
def scheduler():
    """The address of a scheduler in this process, with one worker in this process."""
    distributed = pytest.importorskip("distributed")
    options = {"processes": False, "n_workers": 1, "threads_per_worker": 2, "dashboard_address": "127.0.0.1:0"}
    with distributed.LocalCluster(protocol="tcp", host="127.0.0.1", **options) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def workers(scheduler):
    with open_cluster(scheduler=scheduler) as cluster:
        yield cluster
