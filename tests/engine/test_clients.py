"""Runners: prerequisites, failures, the order of tasks, and the start of local workers."""

import gc
import os
import time
from dataclasses import dataclass
from pathlib import Path

import dask
import numpy as np
import pandas as pd
import psutil
import pyarrow as pa
import pytest
from distributed import Client, LocalCluster
from romandask.engine.submission import ATTEMPTS
from romandask.engine.task_queue import TaskQueue

from romandask.engine import clients
from romandask.engine.clients import runner
from romandask.engine.task import Batch, Task
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


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 1])
def test_units_that_depend_on_a_failed_unit_are_skipped_and_all_others_are_made(tmp_path, workers):
    maker = FailingMaker(tmp_path, (1,))
    units = tuple(Unit(f"u{k}", k) for k in range(6))
    product = TableProduct(stage="table/x", units=units, make=maker, schema=pa.schema([("number", pa.int64())]))
    # unit 1 fails; 2 and 4 need it and 3 needs 2; 5 needs only 0
    prerequisites = {2: (1,), 3: (2,), 4: (1, 0), 5: (0,)}
    tasks = [Task(k, "inputs", 1.0, "", prerequisites.get(k, ())) for k in range(6)]
    store = Store(tmp_path / "store")
    with runner(workers, 1.5) as execution:
        outcomes = {outcome.index: outcome for outcome in execution.run(Batch(product, tasks, store))}
    assert sorted(outcomes) == [0, 1, 2, 3, 4, 5]
    assert {k for k, outcome in outcomes.items() if outcome.record is None} == {1, 2, 3, 4}
    assert "ArithmeticError: unit 1 cannot be made" in outcomes[1].failure
    for k in (2, 3, 4):
        assert not (tmp_path / f"{k}.tried").exists(), "a skipped unit is not tried"
        assert "u1" in outcomes[k].failure or "u2" in outcomes[k].failure
    attempts = len((tmp_path / "1.tried").read_text())
    assert attempts == (ATTEMPTS if workers else 1)
    for k in (0, 5):
        assert product.stored(store).load(k)["number"].tolist() == [k]


@dataclass(frozen=True)
class SlowMaker:
    """Makes one row per unit with the process id, slowly."""

    def __call__(self, index: int) -> pd.DataFrame:
        time.sleep(0.4)
        return pd.DataFrame({"process": np.array([os.getpid()], np.int64)})


@pytest.mark.slow
def test_the_last_of_a_few_long_units_goes_to_a_free_worker(tmp_path):
    """Of three units on two workers, the third goes to the worker that is free first, whatever dask has timed."""
    units = tuple(Unit(f"u{k}", k) for k in range(3))
    product = TableProduct(
        stage="table/x",
        units=units,
        make=SlowMaker(),
        schema=pa.schema([("process", pa.int64())]),
        seconds_per_unit=60.0,
    )
    store = Store(tmp_path / "store")
    with runner(2, 1.5) as execution:
        tasks = [Task(k, "inputs", 1.0, f"key {k % 2}") for k in range(3)]
        outcomes = list(execution.run(Batch(product, tasks, store)))
    assert all(outcome.record for outcome in outcomes)
    processes = [product.stored(store).load(k)["process"].iloc[0] for k in range(3)]
    assert len(set(processes)) == 2


def test_a_free_worker_continues_with_its_affinity_key():
    tasks = [Task(k, "inputs", 1.0, affinity) for k, affinity in enumerate(["a", "a", "b", "b", "c"])]
    waiting = TaskQueue(tasks)
    assert waiting.next(None, ()).index == 0
    # a second worker starts with a key that no other worker has, and continues with it
    assert waiting.next(None, {"a"}).index == 2
    assert waiting.next("b", {"a"}).index == 3
    assert waiting.next("b", {"a"}).index == 4
    # without other tasks left, it takes one of a busy key
    assert waiting.next("c", {"a"}).index == 1
    assert not waiting


def test_the_most_expensive_task_is_first_and_prerequisites_are_before_their_dependents():
    tasks = [
        Task(0, "", 1.0, "x"),
        Task(1, "", 5.0, "y"),
        Task(2, "", 3.0, "x", prerequisites=(0,)),
        Task(3, "", 2.0, "z"),
    ]
    waiting = TaskQueue(tasks)
    assert [waiting.next().index for _ in tasks] == [1, 0, 2, 3]


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
    tasks = [Task(k, "inputs", 1.0) for k in range(3)]
    with dask.config.set({"distributed.deploy.lost-worker-timeout": "1s"}), runner(1, 1.5) as execution:
        execution._client.retire_workers(close_workers=True)
        assert not execution._client.scheduler_info()["workers"]
        outcomes = list(execution.run(Batch(product, tasks, Store(tmp_path / "store"))))
    assert all(outcome.record is not None for outcome in outcomes)
    assert len(outcomes) == 3


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
