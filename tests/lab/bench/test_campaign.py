"""Campaigns: the same records by any number of workers, and none lost with a worker."""

import json
import math
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import lavender as lv
from lavender import bench, report
from lavender.lab.bench.record import to_json
from lavender.lab.bench.running import campaign as module
from lavender.lab.report import tables
from lavender.lab.report.findings import Report

NAMES = bench.seeds(["random_spd(n=12, condition=100)", "granular(n=2)", "toy_stack"], 4)
PLAN = bench.CampaignPlan(levels=(1e-3, 1e-6), budgets=(4, 8), orders=("random:1",))


def lines(records):
    return [json.dumps(to_json(r)) for r in records]


def test_seeds_are_spread_over_cases_that_take_one():
    assert bench.seeds(["granular(n=2)", "random_spd(seed=5)", "toy_stack", "@hard"], 2) == [
        "granular(n=2, seed=0)",
        "granular(n=2, seed=1)",
        "random_spd(seed=5)",
        "toy_stack",
        "@hard",
    ]
    assert bench.seeds(["granular(n=2)"], 2, first=7) == ["granular(n=2, seed=7)", "granular(n=2, seed=8)"]
    with pytest.raises(lv.InputError):
        bench.seeds(["2 +"], 2)


def test_the_same_bits_by_one_worker_and_by_two_and_no_times():
    one = bench.campaign(NAMES, ["pgs", "direct"], PLAN, workers=1)
    two = bench.campaign(NAMES, ["pgs", "direct"], PLAN, workers=2)
    assert lines(one) == lines(two)
    assert [s.case for s in one.skips] == [s.case for s in two.skips]
    assert len({r.case for r in one}) == len(NAMES) == 9
    assert all(math.isnan(r.time_min) and math.isnan(r.setup_min) for r in one)
    for r in one:
        if r.case == NAMES[0] and r.solver == "pgs" and r.mode == "budget" and r.order == "given":
            from lavender import suite

            again = lv.solve(suite.case(NAMES[0]).problem, "pgs", tol=0.0, max_iter=r.max_iter)
            assert again.residual.relative == r.relative


def test_what_ends_a_campaign_comes_alone_and_its_report_says_so(tmp_path, recwarn):
    def full(event):
        raise OSError("no room")

    path = tmp_path / "records.jsonl"
    with pytest.raises(OSError, match="no room"):
        bench.campaign(NAMES, ["pgs", "direct"], PLAN, path, workers=2, watch=full)
    assert not recwarn.list
    assert Report(bench.read(path)).stopped
    bench.campaign(NAMES, ["pgs", "direct"], PLAN, path, workers=1)
    assert not Report(bench.read(path)).stopped


def test_a_file_that_has_changed_is_run_again(tmp_path):
    plan, file = bench.CampaignPlan(levels=(1e-6,), budgets=(), orders=()), tmp_path / "file.npz"

    def shas():
        out = bench.campaign([file], ["pgs", "direct"], plan, tmp_path / "records.jsonl", workers=1)
        return {(r.solver, r.sha) for r in out}, len(out.skips)

    lv.Problem.lcp(np.eye(2), np.ones(2)).save(file)
    first = shas()
    assert shas() == first and len(first[0]) == 2 and not first[1]
    file.write_bytes(b"broken")
    assert shas() == (set(), 1)
    lv.Problem.lcp(2.0 * np.eye(2), np.ones(2)).save(file)
    second = shas()
    assert len(second[0] - first[0]) == 2 == len(second[0]) and not second[1]


def test_problems_and_files_travel_too(tmp_path):
    from lavender import io

    p = lv.Problem.lcp(np.array([[2.0, 1.0], [1.0, 2.0]]), np.ones(2), name="mine")
    io.save(p, tmp_path / "file.npz")
    (tmp_path / "bad.npz").write_bytes(b"broken")
    plan = bench.CampaignPlan(levels=(1e-6,), budgets=(), orders=())
    records = bench.campaign([p, tmp_path / "file.npz", tmp_path / "bad.npz"], ["pgs"], plan, workers=2)
    assert [(r.case, r.success) for r in records] == [("mine", True), ("file", True)]
    assert ["did not load" in s.reason for s in records.skips] == [True]


def test_a_solver_that_is_registered_here_alone_travels_even_under_a_name_of_ours(plug_in):
    mine = lv.Status.MAX_ITERATIONS
    for name in ("here alone", "pgs"):
        plug_in(lambda problem, impulse: lv.Claim(mine, 1, {"mine": 1}), name)
    plan = bench.CampaignPlan(levels=(1e-6,), budgets=(), orders=())
    records = bench.campaign(["toy_stack"], ["here alone", "pgs"], plan, workers=2)
    assert [dict(r.work) for r in records] == 2 * [{"mine": 1}]


@pytest.mark.parametrize(
    ("backend", "sign"),
    [
        ("nowhere", "'loky' runs processes"),
        ("loky=here", "'loky' runs processes"),
        ("dask=tcp://127.0.0.1:1", "no dask scheduler answers"),
        ("dask", "DASK_SCHEDULER_ADDRESS"),
    ],
)
def test_a_backend_that_is_not_there_is_an_input_error(backend, sign, monkeypatch):
    if backend.startswith("dask"):
        pytest.importorskip("distributed", reason="a cluster needs dask.distributed (extra: cluster)")
        monkeypatch.setattr(sys.modules["lavender.lab.bench.running.campaign"], "CONNECT", 0.2)
    with pytest.raises(lv.InputError, match=sign):
        bench.campaign(NAMES[:1], ["pgs"], PLAN, backend=backend)


@pytest.mark.parametrize(
    ("backend", "package"), [("dask", "lavender-contact\\[cluster\\]"), ("ray", "ray\\[default\\]")]
)
def test_a_cluster_without_its_package_says_what_to_install(backend, package, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed" if backend == "dask" else "ray", None)
    with pytest.raises(lv.InputError, match=f"pip install '{package}'"):
        bench.campaign(NAMES[:1], ["pgs"], PLAN, backend=backend)


@pytest.mark.slow
def test_ray_gives_the_same_bits():
    ray = pytest.importorskip("ray", reason="a ray cluster needs ray")
    expected = bench.campaign(NAMES[:2], ["pgs"], PLAN, workers=1)
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
    try:
        assert lines(bench.campaign(NAMES[:2], ["pgs"], PLAN, workers=1, backend="ray")) == lines(expected)
    finally:
        ray.shutdown()


def test_the_report_of_a_campaign_shows_shares_and_no_times(tmp_path):
    records = bench.campaign(NAMES, ["pgs", "direct"], PLAN, workers=1)
    rows = {(r.family, r.solver): r for r in tables.robustness(records)}
    dense = rows["dense", "direct"]
    assert (dense.cases, dense.reached[1e-6], dense.wrong, dense.died) == (4, 4, 0, 0)
    budget = [
        r.relative for r in records if "random_spd" in r.case and r.max_iter == 8 and r.order == "given"
    ]
    assert rows["dense", "pgs"].budgets[8] == (np.median(budget), max(budget))
    text = report.write(records, tmp_path).read_text()
    assert "Campaign" in text
    assert "Which solver</h2>" not in text
    assert not (tmp_path / "figures").exists()


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_midway_loses_no_record():
    distributed = pytest.importorskip(
        "distributed", reason="a cluster needs dask.distributed (extra: cluster)"
    )
    names = bench.seeds(["granular(n=2)"], 16)
    plan = bench.CampaignPlan(levels=(1e-6,), budgets=(8, 64), orders=())
    expected = bench.campaign(names, ["pgs", "jacobi"], plan, workers=1)
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        pids = list(client.run(os.getpid).values())
        assert len(set(pids)) == 2
        half = threading.Event()

        def watch(event):
            if event.done >= event.total // 3 and not half.is_set():
                half.set()
                os.kill(pids[0], signal.SIGKILL)

        found = bench.campaign(names, ["pgs", "jacobi"], plan, backend="dask", watch=watch)
        while pids[0] in client.run(os.getpid, on_error="ignore").values():  # until the cluster has noticed
            time.sleep(0.1)
    assert half.is_set()
    assert lines(found) == lines(expected)


@pytest.mark.slow
def test_a_cluster_that_goes_midway_is_told_and_the_next_one_goes_on(tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="a cluster needs dask.distributed (extra: cluster)")
    names, path = bench.seeds(["granular(n=2)"], 40), tmp_path / "records.jsonl"
    plan = bench.CampaignPlan(levels=(1e-6,), budgets=(8, 64), orders=())
    code = (
        "import sys, distributed\n"
        "if __name__ == '__main__':\n"
        "    c = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=':0')\n"
        "    print(c.scheduler_address, flush=True)\n"
        "    sys.stdin.read()\n"
    )
    monkeypatch.setattr(module, "CONNECT", 1.0)
    cluster = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        address = cluster.stdout.readline().strip()

        def watch(event):
            if event.done == event.total // 10:
                cluster.kill()

        with pytest.raises(OSError, match="tcp://"):
            bench.campaign(names, ["pgs"], plan, path, backend=f"dask={address}", watch=watch)
    finally:
        cluster.kill()
        cluster.communicate()
    done = len(bench.read(path).done)
    assert 0 < done < len(names)
    found = bench.campaign(names, ["pgs"], plan, path, workers=1)
    assert lines(found) == lines(bench.campaign(names, ["pgs"], plan, workers=1))


def test_errors_travel_between_processes():
    import pickle

    error = lv.UnknownName("solver", "pgz", ["pgs"])
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again)) == (lv.UnknownName, str(error))
