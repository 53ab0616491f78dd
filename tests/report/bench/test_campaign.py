"""Campaigns: the same records with any number of workers, and none lost with a worker."""

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
from lavender import bench, report, suite
from lavender.report.bench import statistics
from lavender.report.bench.record import to_json
from lavender.report.bench.running import workers as workers_module
from lavender.report.findings import Report

SEEDED = [f"granular(n=2, seed={i})" for i in range(40)]
NAMES = [*(f"random_spd(n=12, condition=100, seed={i})" for i in range(4)), *SEEDED[:4], "toy_stack"]
PLAN = bench.CampaignPlan(tolerances=(1e-3, 1e-6), budgets=(4, 8), orders=("random:1",))
SHORT = bench.CampaignPlan(tolerances=(1e-6,), budgets=(), orders=())


def lines(records):
    return [json.dumps(to_json(r)) for r in records]


def test_one_worker_and_two_give_the_same_bits_and_no_times():
    one = bench.run(NAMES, ["pgs", "direct"], PLAN)
    two = bench.run(NAMES, ["pgs", "direct"], PLAN, workers=2)
    assert lines(one) == lines(two)
    assert [s.case for s in one.skips] == [s.case for s in two.skips]
    assert lines(one.cases.values()) == lines(two.cases.values())
    assert len({r.case for r in one}) == len(NAMES) == 9
    assert all(math.isnan(r.time_min) and math.isnan(r.setup_min) for r in one)
    for r in one:
        if r.case == NAMES[0] and r.solver == "pgs" and r.mode == "budget" and r.order == "given":
            again = lv.solve(suite.case(NAMES[0]).problem, "pgs", tol=0.0, max_iter=r.max_iter)
            assert again.residual.relative == r.relative


def test_workers_measure_no_times():
    assert bench.run(["toy_stack"], ["direct"], workers=2).runs.popitem()[1].plan["campaign"]
    with pytest.raises(lv.InputError, match="give a CampaignPlan, or workers=1"):
        bench.run(["toy_stack"], ["direct"], bench.Plan(), workers=2)


def test_an_exception_stops_the_workers_without_warnings_and_the_report_says_so(tmp_path, recwarn):
    def stop(event):
        raise OSError("no room")

    path, stored = tmp_path / "records.jsonl", []
    with pytest.raises(OSError, match="no room"):
        bench.run(NAMES, ["pgs", "direct"], PLAN, path, workers=2, watch=stop, into=stored)
    assert not recwarn.list
    assert Report(bench.read_records(path)).stopped_warning and Report(stored[0]).stopped_warning
    assert lines(stored[0]) == lines(bench.read_records(path))
    bench.run(NAMES, ["pgs", "direct"], PLAN, path)
    assert not Report(bench.read_records(path)).stopped_warning


def test_a_file_that_has_changed_and_a_plan_that_asks_for_more_are_run_again(tmp_path):
    file = tmp_path / "file.npz"

    def run(plan):
        return bench.run([file], ["pgs", "direct"], plan, tmp_path / "records.jsonl")

    def shas():
        out = run(SHORT)
        return {(r.solver, r.sha) for r in out}, len(out.skips)

    lv.Problem.lcp(np.eye(2), np.ones(2)).save(file)
    first = shas()
    assert shas() == first and len(first[0]) == 2 and not first[1]
    file.write_bytes(b"broken")
    assert shas() == (set(), 1)
    lv.Problem.lcp(2.0 * np.eye(2), np.ones(2)).save(file)
    second = shas()
    assert len(second[0] - first[0]) == 2 == len(second[0]) and not second[1]
    more = bench.CampaignPlan(tolerances=(1e-3, 1e-6), budgets=(), orders=())
    assert {r.tol for r in run(more) if r.solver == "pgs"} == {1e-3, 1e-6}


def test_problems_files_and_solvers_of_this_process_are_sent_to_workers(tmp_path, plug_in):
    p = lv.Problem.lcp(np.array([[2.0, 1.0], [1.0, 2.0]]), np.ones(2), name="mine")
    lv.io.save(p, tmp_path / "file.npz")
    (tmp_path / "bad.npz").write_bytes(b"broken")
    steps = bench.make_sequence([p, p], "steps")
    found = bench.run([p, tmp_path / "file.npz", tmp_path / "bad.npz", *steps], ["direct"], SHORT, workers=2)
    assert [(r.case, r.success) for r in found] == [
        (n, True) for n in ("mine", "file", "steps[0]", "steps[1]")
    ]
    assert ["did not load" in s.reason for s in found.skips] == [True]
    for name in ("here alone", "pgs"):  # also under the name of one of ours
        plug_in(lambda problem, impulse: lv.Claim(lv.Status.MAX_ITERATIONS, 1, {"mine": 1}), name)
    found = bench.run(["toy_stack"], ["here alone", "pgs"], SHORT, workers=2)
    assert [dict(r.work) for r in found] == 2 * [{"mine": 1}]


@pytest.mark.parametrize(
    ("backend", "missing", "sign"),
    [
        ("nowhere", "", "'loky' runs processes"),
        ("loky=here", "", "'loky' runs processes"),
        ("dask=tcp://127.0.0.1:1", "", "no dask scheduler answers"),
        ("dask", "", "DASK_SCHEDULER_ADDRESS"),
        ("dask", "distributed", r"pip install 'lavender-contact\[cluster\]'"),
        ("ray", "ray", r"pip install 'ray\[default\]'"),
    ],
)
def test_a_backend_that_cannot_be_used_is_an_input_error(backend, missing, sign, monkeypatch):
    if missing:
        monkeypatch.setitem(sys.modules, missing, None)
    elif backend.startswith("dask"):
        pytest.importorskip("distributed", reason="a cluster needs dask.distributed (extra: cluster)")
        monkeypatch.setattr(workers_module, "CONNECT_TIMEOUT", 0.2)
    with pytest.raises(lv.InputError, match=sign):
        bench.run(NAMES[:1], ["pgs"], PLAN, backend=backend)


@pytest.mark.slow
def test_ray_gives_the_same_bits():
    ray = pytest.importorskip("ray", reason="a ray cluster needs ray")
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
    try:
        found = bench.run(NAMES[:2], ["pgs"], PLAN, backend="ray")
    finally:
        ray.shutdown()
    assert lines(found) == lines(bench.run(NAMES[:2], ["pgs"], PLAN))


def test_the_report_of_a_campaign_shows_shares_and_no_times(tmp_path):
    records = bench.run(NAMES, ["pgs", "direct"], PLAN)
    rows = {(r.family, r.solver): r for r in statistics.compute_robustness(records)}
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


@pytest.mark.nightly
def test_a_cluster_that_loses_a_worker_midway_loses_no_record():
    distributed = pytest.importorskip(
        "distributed", reason="a cluster needs dask.distributed (extra: cluster)"
    )
    names = SEEDED[:16]
    plan = bench.CampaignPlan(tolerances=(1e-6,), budgets=(8, 64), orders=())
    expected = bench.run(names, ["pgs", "jacobi"], plan)
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

        found = bench.run(names, ["pgs", "jacobi"], plan, backend="dask", watch=watch)
        while pids[0] in client.run(os.getpid, on_error="ignore").values():  # until the cluster has noticed
            time.sleep(0.1)
    assert half.is_set()
    assert lines(found) == lines(expected)


@pytest.mark.nightly
def test_after_a_cluster_that_goes_midway_the_next_run_goes_on(tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="a cluster needs dask.distributed (extra: cluster)")
    names, path = SEEDED, tmp_path / "records.jsonl"
    plan = bench.CampaignPlan(tolerances=(1e-6,), budgets=(8, 64), orders=())
    code = (
        "import sys, distributed\n"
        "if __name__ == '__main__':\n"
        "    c = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=':0')\n"
        "    print(c.scheduler_address, flush=True)\n"
        "    sys.stdin.read()\n"
    )
    monkeypatch.setattr(workers_module, "CONNECT_TIMEOUT", 1.0)
    cluster = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        address = cluster.stdout.readline().strip()

        def watch(event):
            if event.done == event.total // 10:
                cluster.kill()

        with pytest.raises(OSError, match="tcp://"):
            bench.run(names, ["pgs"], plan, path, backend=f"dask={address}", watch=watch)
    finally:
        cluster.kill()
        cluster.communicate()
    assert 0 < len(bench.read_records(path).cases) < len(names)
    assert lines(bench.run(names, ["pgs"], plan, path)) == lines(bench.run(names, ["pgs"], plan))


def test_errors_are_sent_between_processes():
    import pickle

    error = lv.UnknownName("solver", "pgz", ["pgs"])
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again)) == (lv.UnknownName, str(error))
