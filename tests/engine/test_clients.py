"""Runners: units that come after others, and what becomes of them when one fails."""

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

from romandask.engine import clients
from romandask.engine.clients import runner
from romandask.engine.submission import ATTEMPTS
from romandask.engine.task import Batch, Task
from romandask.engine.task_queue import TaskQueue
from romandask.model.errors import UserError
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.storage.store import Store


@dataclass(frozen=True)
class Failing:
    """Makes a row of each unit, counts how often it is asked, and fails for some."""

    folder: Path
    bad: tuple[int, ...]

    def __call__(self, index: int) -> pd.DataFrame:
        tried = self.folder / f"{index}.tried"
        with tried.open("a") as file:
            file.write("x")
        if index in self.bad:
            raise ArithmeticError(f"unit {index} cannot be made")
        return pd.DataFrame({"number": np.array([index], np.int64)})


@pytest.mark.parametrize("workers", [0, 1])
def test_units_after_one_that_fails_are_given_up_and_named_and_others_are_made(tmp_path, workers):
    maker = Failing(tmp_path, (1,))
    units = tuple(Unit(f"u{k}", k) for k in range(6))
    product = TableProduct(stage="table/x", units=units, make=maker, schema=pa.schema([("number", pa.int64())]))
    # 1 fails; 2 and 4 come after it, 3 after 2; 0 and 5 have nothing to do with it, 5 comes after 0
    after = {2: (1,), 3: (2,), 4: (1, 0), 5: (0,)}
    tasks = [Task(k, "inputs", 1.0, "", after.get(k, ())) for k in range(6)]
    store = Store(tmp_path / "store")
    with runner(workers, 1.5) as execution:
        outcomes = {outcome.index: outcome for outcome in execution.run(Batch(product, tasks, store))}
    assert sorted(outcomes) == [0, 1, 2, 3, 4, 5]
    assert {k for k, outcome in outcomes.items() if outcome.record is None} == {1, 2, 3, 4}
    assert "ArithmeticError: unit 1 cannot be made" in outcomes[1].failure
    for k in (2, 3, 4):
        assert not (tmp_path / f"{k}.tried").exists(), "what comes after it is not even tried"
        assert "u1" in outcomes[k].failure or "u2" in outcomes[k].failure
    tries = len((tmp_path / "1.tried").read_text())
    assert tries == (ATTEMPTS if workers else 1)
    for k in (0, 5):
        assert product.stored(store).load(k)["number"].tolist() == [k]


@dataclass(frozen=True)
class Slow:
    """Makes a row of each unit, slowly, with the number of the process."""

    def __call__(self, index: int) -> pd.DataFrame:
        time.sleep(0.4)
        return pd.DataFrame({"process": np.array([os.getpid()], np.int64)})


def test_the_last_of_a_few_long_units_does_not_wait_behind_another(tmp_path):
    """Three units on two workers: the third goes to the worker that is free first, whatever dask thinks of them."""
    units = tuple(Unit(f"u{k}", k) for k in range(3))
    product = TableProduct(
        stage="table/x", units=units, make=Slow(), schema=pa.schema([("process", pa.int64())]), seconds_per_unit=60.0
    )
    store = Store(tmp_path / "store")
    with runner(2, 1.5) as execution:
        tasks = [Task(k, "inputs", 1.0, f"kin {k % 2}") for k in range(3)]
        found = list(execution.run(Batch(product, tasks, store)))
    assert all(outcome.record for outcome in found)
    processes = [product.stored(store).load(k)["process"].iloc[0] for k in range(3)]
    assert len(set(processes)) == 2


def test_a_free_worker_goes_on_with_the_kin_that_it_knows():
    tasks = [Task(k, "inputs", 1.0, kin) for k, kin in enumerate(["a", "a", "b", "b", "c"])]
    waiting = TaskQueue(tasks)
    assert waiting.next(None, ()).index == 0
    # another worker begins with a kin that nobody works on, and goes on with it
    assert waiting.next(None, {"a"}).index == 2
    assert waiting.next("b", {"a"}).index == 3
    assert waiting.next("b", {"a"}).index == 4
    # rather than stand idle it helps with the other's
    assert waiting.next("c", {"a"}).index == 1
    assert not waiting


def test_dear_tasks_come_first_and_none_before_what_it_comes_after():
    tasks = [
        Task(0, "", 1.0, "x"),
        Task(1, "", 5.0, "y"),
        Task(2, "", 3.0, "x", prerequisites=(0,)),
        Task(3, "", 2.0, "z"),
    ]
    waiting = TaskQueue(tasks)
    assert [waiting.next().index for _ in tasks] == [1, 0, 2, 3]


def test_workers_that_die_before_they_begin_are_started_again(monkeypatch):
    """Twice in a row is bad luck; always is told in one line."""
    starts = []

    class Dying(LocalCluster):
        def __init__(self, **kwargs):
            starts.append(kwargs["n_workers"])
            if len(starts) < 3:
                raise RuntimeError("Nanny failed to start.")
            super().__init__(**kwargs)

    monkeypatch.setattr(clients, "LocalCluster", Dying)
    with runner(1, 1.5) as execution:
        assert "1 local workers" in execution.description
    assert starts == [1, 1, 1]
    monkeypatch.setattr(clients, "START_ATTEMPTS", 2)
    starts.clear()
    with pytest.raises(UserError, match="Nanny failed to start"), runner(1, 1.5):
        pass
    assert starts == [1, 1]


def test_local_workers_that_are_gone_for_good_are_started_again(tmp_path):
    """As when one dies while its nanny starts it: dask leaves it at that."""
    units = tuple(Unit(f"u{k}", k) for k in range(3))
    product = TableProduct(
        stage="table/x", units=units, make=Failing(tmp_path, ()), schema=pa.schema([("number", pa.int64())])
    )
    tasks = [Task(k, "inputs", 1.0) for k in range(3)]
    with dask.config.set({"distributed.deploy.lost-worker-timeout": "1s"}), runner(1, 1.5) as execution:
        execution._client.retire_workers(close_workers=True)
        assert not execution._client.scheduler_info()["workers"]
        outcomes = list(execution.run(Batch(product, tasks, Store(tmp_path / "store"))))
    assert all(outcome.record is not None for outcome in outcomes)
    assert len(outcomes) == 3


def test_a_local_cluster_listens_on_the_loopback_alone():
    with runner(2, 1.5):
        here = psutil.Process()
        ports = [
            connection.laddr
            for process in (here, *here.children(recursive=True))
            for connection in process.net_connections(kind="inet")
            if connection.status == psutil.CONN_LISTEN
        ]
    assert len(ports) >= 4, "scheduler, dashboard, workers"
    assert {address.ip for address in ports} == {"127.0.0.1"}


def test_of_a_client_that_finds_no_scheduler_nothing_is_left():
    """Collected later, while another one starts, it would wait for ever."""
    gc.collect()
    gc.disable()
    try:
        with (
            dask.config.set({"distributed.comm.require-encryption": True}),
            pytest.raises(UserError, match="encryption required"),
            runner(1, 2.0, "tcp://127.0.0.1:1"),
        ):
            pass
        assert not [each for each in gc.get_objects() if isinstance(each, Client)]
    finally:
        gc.enable()
