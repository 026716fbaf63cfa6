"""Runners: prerequisites, failures, the order of tasks, and the start of local workers."""

import gc
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import dask
import numpy as np
import pandas as pd
import psutil
import pyarrow as pa
import pytest
from distributed import Client, LocalCluster

from romandask.engine import clients
from romandask.engine.clients import runner
from romandask.engine.graph import RETRIES, UnitGraph
from romandask.engine.lost_units import Lost
from romandask.engine.runners import Ended
from romandask.model.errors import UserError
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.storage.store import Store


@dataclass(frozen=True)
class FailingMaker:
    """Makes one row per unit, fails for some units, and counts the attempts in files."""

    folder: Path
    failing: tuple[int, ...]

    def __call__(self, index: int) -> pd.DataFrame:
        attempts = self.folder / f"{index}.tried"
        with attempts.open("a") as file:
            file.write("x")
        if index in self.failing:
            raise ArithmeticError(f"unit {index} cannot be made")
        return pd.DataFrame({"number": np.array([index], np.int64)})


def graph_of(product: TableProduct, store: Store, sources: dict[int, tuple[int, ...]] | None = None) -> UnitGraph:
    """Return the graph of all units of a product, some of which wait for others."""
    (stage,) = UnitGraph.of(product, store).stages
    waits = {
        name: tuple((product.stage, product.names[k]) for k in (sources or {}).get(index, ()))
        for index, name in enumerate(product.names)
    }
    return UnitGraph([replace(stage, sources=waits)], store)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 1])
def test_units_that_depend_on_a_failed_unit_are_skipped_and_all_others_are_made(tmp_path, workers):
    maker = FailingMaker(tmp_path, (1,))
    units = tuple(Unit(f"u{k}", k) for k in range(6))
    product = TableProduct(stage="table/x", units=units, make=maker, schema=pa.schema([("number", pa.int64())]))
    store = Store(tmp_path / "store")
    # unit 1 fails; 2 and 4 need it and 3 needs 2; 5 needs only 0
    graph = graph_of(product, store, {2: (1,), 3: (2,), 4: (1, 0), 5: (0,)})
    with runner(workers, 1.5) as execution:
        ends = {int(ended.source[1][1:]): ended for ended in execution.run(graph)}
    assert sorted(ends) == [0, 1, 2, 3, 4, 5]
    assert {k for k, ended in ends.items() if ended.result is None} == {1, 2, 3, 4}
    assert "ArithmeticError: unit 1 cannot be made" in ends[1].failure
    for k in (2, 3, 4):
        assert not (tmp_path / f"{k}.tried").exists(), "a skipped unit is not tried"
    attempts = len((tmp_path / "1.tried").read_text())
    assert attempts == (1 + RETRIES if workers else 1)
    for k in (0, 5):
        assert product.stored(store).load(k)["number"].tolist() == [k]


@dataclass(frozen=True)
class SlowMaker:
    """Makes one row per unit with the process id, slowly."""

    seconds: float = 0.4

    def __call__(self, index: int) -> pd.DataFrame:
        time.sleep(self.seconds)
        return pd.DataFrame({"process": np.array([os.getpid()], np.int64)})


PROCESS = pa.schema([("process", pa.int64())])


@pytest.mark.slow
def test_a_unit_goes_to_a_worker_with_a_free_thread(tmp_path):
    """Of three units on two workers, the third goes to the worker that is free first; none waits behind another."""
    units = tuple(Unit(f"u{k}", k) for k in range(3))
    product = TableProduct(stage="table/x", units=units, make=SlowMaker(), schema=PROCESS)
    store = Store(tmp_path / "store")
    with runner(2, 1.5) as execution:
        assert all(ended.result for ended in execution.run(UnitGraph.of(product, store)))
    processes = [product.stored(store).load(k)["process"].iloc[0] for k in range(3)]
    assert len(set(processes)) == 2


@dataclass(frozen=True)
class DyingMaker:
    """Ends its worker by a signal at the first attempt."""

    path: Path

    def __call__(self, index: int) -> pd.DataFrame:
        if not self.path.exists():
            self.path.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return pd.DataFrame({"process": np.array([os.getpid()], np.int64)})


@pytest.mark.slow
def test_a_unit_that_is_lost_with_its_worker_is_made_again_and_reported(tmp_path):
    product = TableProduct(stage="table/x", units=(Unit("u0", 0),), make=DyingMaker(tmp_path / "died"), schema=PROCESS)
    with runner(1, 1.5) as execution:
        ends = list(execution.run(UnitGraph.of(product, Store(tmp_path / "store"))))
    losses = [end for end in ends if isinstance(end, Lost)]
    assert losses == [Lost(("table/x", "u0"), "signal SIGKILL")]
    assert [end.result.made for end in ends if isinstance(end, Ended)] == [True]


def test_workers_that_die_during_their_start_are_started_again(monkeypatch):
    """The third attempt succeeds; after the last attempt, the error is one line."""
    starts = []

    class DyingCluster(LocalCluster):
        def __init__(self, **kwargs):
            starts.append(kwargs["n_workers"])
            if len(starts) < 3:
                raise RuntimeError("Nanny failed to start.")
            super().__init__(**kwargs)

    monkeypatch.setattr(clients, "LocalCluster", DyingCluster)
    with runner(1, 1.5) as execution:
        assert "1 local workers" in execution.description
    assert starts == [1, 1, 1]
    monkeypatch.setattr(clients, "START_ATTEMPTS", 2)
    starts.clear()
    with pytest.raises(UserError, match="Nanny failed to start"), runner(1, 1.5):
        pass
    assert starts == [1, 1]


@pytest.mark.slow
def test_lost_local_workers_are_started_again(tmp_path):
    """dask does not restart a worker that dies while its nanny starts it."""
    units = tuple(Unit(f"u{k}", k) for k in range(3))
    product = TableProduct(
        stage="table/x", units=units, make=FailingMaker(tmp_path, ()), schema=pa.schema([("number", pa.int64())])
    )
    with dask.config.set({"distributed.deploy.lost-worker-timeout": "1s"}), runner(1, 1.5) as execution:
        execution._client.retire_workers(close_workers=True)
        assert not execution._client.scheduler_info()["workers"]
        ends = list(execution.run(UnitGraph.of(product, Store(tmp_path / "store"))))
    assert all(ended.result is not None for ended in ends)
    assert len(ends) == 3


def test_a_local_cluster_listens_only_on_the_loopback_interface():
    with runner(2, 1.5):
        driver = psutil.Process()
        ports = [
            connection.laddr
            for process in (driver, *driver.children(recursive=True))
            for connection in process.net_connections(kind="inet")
            if connection.status == psutil.CONN_LISTEN
        ]
    assert len(ports) >= 4, "scheduler, dashboard, workers"
    assert {address.ip for address in ports} == {"127.0.0.1"}


def test_a_client_that_finds_no_scheduler_is_collected_at_once():
    """If it were collected later, while another client starts, its close would wait for ever."""
    gc.collect()
    gc.disable()
    try:
        with (
            dask.config.set({"distributed.comm.require-encryption": True}),
            pytest.raises(UserError, match="encryption required"),
            runner(1, 2.0, "tcp://127.0.0.1:1"),
        ):
            pass
        assert not [item for item in gc.get_objects() if isinstance(item, Client)]
    finally:
        gc.enable()


@pytest.mark.slow
def test_a_script_without_a_main_guard_is_told_so(tmp_path):
    """Each worker runs the script again before it starts."""
    lines = ["from romandask.engine.clients import runner", "with runner(2, 1.5):", '    print("started")']
    (tmp_path / "script.py").write_text("\n".join(lines))
    done = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert re.search(r"UserError: .*script\.py: worker processes import this script.* if __name__ == ", last)
    assert done.stderr.count("Traceback") == 1, "only that of the script itself"
    assert done.stdout == ""
    guarded = "\n".join([lines[0], 'if __name__ == "__main__":', *(f"    {line}" for line in lines[1:])])
    (tmp_path / "script.py").write_text(guarded)
    done = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "started\n", "")
