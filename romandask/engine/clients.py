"""Clusters on which a survey is run: one-thread processes of this machine, or a cluster that exists.

No other module imports distributed.
"""

from __future__ import annotations

import gc
import re
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import dask
import yaml
from distributed import Client, LocalCluster, Nanny, performance_report
from distributed.utils import LoopRunner

from romandask.engine.lost_units import EXIT_TOPIC
from romandask.engine.runners import InProcess, OnCluster, Runner
from romandask.engine.worker_start import (
    main_guard_demanded,
    script_ran_again,
    sigint_blocked,
    start_resource_tracker,
)
from romandask.model.errors import UserError
from romandask.model.resources import resource_folder
from romandask.storage.paths import AnyPath, write_bytes

START_ATTEMPTS = 3
"""Number of attempts to start a local cluster."""


@contextmanager
def _recording(client: Client, path: AnyPath) -> Iterator[None]:
    # dask writes a local file without external assets (inline); the store receives it as a whole
    with TemporaryDirectory(prefix="romandask-") as folder:
        temporary = Path(folder) / "performance.html"
        report = performance_report(filename=str(temporary), mode="inline")
        with client.as_current():
            report.__enter__()
        try:
            yield
        finally:
            with client.as_current(), suppress(Exception):
                # a report that fails because workers are gone must not fail a finished run
                report.__exit__(None, None, None)
                # the icon is the only external asset of the page
                page = re.sub(r'<link rel="shortcut icon"[^>]*>', "", temporary.read_text(encoding="utf-8"))
                write_bytes(path, page.encode())


@contextmanager
def runner(workers: int, memory_limit: float, scheduler: str | None = None) -> Iterator[Runner]:
    """Return a context manager with a runner.

    Parameters
    ----------
    workers : int
        Number of local worker processes; 0 makes the units in this process. Ignored if `scheduler` is given.
    memory_limit : float
        Memory of each worker, GiB.
    scheduler : str or None
        Address of the scheduler of an existing cluster, for example tcp://host:8786.

    Raises
    ------
    UserError
        If no scheduler answers, its workers have too little memory or another version of romandask, or the local
        workers cannot be started.
    """
    if scheduler is None and workers == 0:
        yield InProcess()
        return
    if scheduler is not None:
        if not re.fullmatch(r"(tcp|tls)://\S+:\d+", scheduler):
            raise UserError(f"--scheduler {scheduler}: write tcp://host:port, or tls://host:port")
        with _connected(scheduler) as client:
            yield on_client(client, memory_limit, f"--scheduler {scheduler}")
        return
    settings = yaml.safe_load((resource_folder("pipelines") / "cluster" / "workers.yaml").read_text())
    with (
        dask.config.set(dask.config.merge({"distributed": dask.config.get("distributed")}, settings)),
        main_guard_demanded(),
        _event_loop() as loop,
        _local_cluster(workers, int(memory_limit * 2**30), loop) as cluster,
        Client(cluster) as client,
    ):
        # dask does not restart a worker that dies during its start; scaling to the wanted number does
        description = f"{workers} local workers, dashboard {cluster.dashboard_link}"
        yield OnCluster(client, description, partial(_recording, client), lambda: cluster.scale(workers))


def _connected(scheduler: str) -> Client:
    try:
        return Client(scheduler, timeout="20s")
    except (OSError, ValueError, TypeError, TimeoutError, RuntimeError) as error:
        # dask raises TypeError for tls:// without certificates
        reason = str(error) or type(error).__name__
    # A client that could not connect closes itself when it is collected. It is collected now, because the close would
    # wait for ever while another client starts in this process.
    gc.collect()
    raise UserError(f"--scheduler {scheduler}: no dask scheduler answers there ({reason})")


def on_client(client: Client, memory_limit: float, cluster_name: str = "the cluster") -> OnCluster:
    """Return a runner on the cluster of a client.

    Parameters
    ----------
    client : distributed.Client
        Connected client.
    memory_limit : float
        Memory that each worker must have, GiB.
    cluster_name : str
        Name of the cluster in error messages.

    Raises
    ------
    UserError
        If the workers have too little memory or another version of romandask.
    """
    _check_workers(client, cluster_name, memory_limit)
    description = f"cluster at {client.scheduler_info(n_workers=0)['address']}, dashboard {client.dashboard_link}"
    return OnCluster(client, description, partial(_recording, client))


class ReportingNanny(Nanny):
    """Nanny that logs an event with the exit code when its worker process ends."""

    def _on_worker_exit_sync(self, exitcode: int) -> None:
        if self.worker_address is not None:
            self.log_event(EXIT_TOPIC, {"worker": self.worker_address, "exitcode": exitcode})
        super()._on_worker_exit_sync(exitcode)


@contextmanager
def _event_loop() -> Iterator[Any]:
    """Run an event loop in a thread that does not receive SIGINT; the processes that it starts do not either."""
    start_resource_tracker()
    loop_runner = LoopRunner()
    with sigint_blocked():
        loop_runner.start()
    try:
        yield loop_runner.loop
    finally:
        loop_runner.stop()


def _local_cluster(workers: int, memory_limit: int, loop: Any) -> LocalCluster:
    """Start one-thread worker processes on the loopback interface; start again if one dies during its start."""
    reason = ""
    for _ in range(START_ATTEMPTS):
        try:
            return _started(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                worker_class=ReportingNanny,
                host="127.0.0.1",
                dashboard_address=f"127.0.0.1:{_free_port(8787)}",
                memory_limit=memory_limit,
                silence_logs=50,
                loop=loop,
            )
        except RuntimeError as error:
            reason = str(error.__cause__ or error)
            if script_ran_again():
                break
    raise UserError(
        f"{workers} local workers cannot be started ({reason}): free memory or processes, or run with --workers 0"
    )


def _started(**options: Any) -> LocalCluster:
    """Return a started cluster. It is started in a thread: an interrupt closes it when it has started, not half-way."""
    with ThreadPoolExecutor(1) as executor:
        starting = executor.submit(LocalCluster, **options)
        try:
            return starting.result()
        except KeyboardInterrupt:
            with suppress(RuntimeError):
                starting.result().close()
            raise


def _check_workers(client: Client, cluster_name: str, memory_limit: float) -> None:
    """Check memory and version of the workers present now. Workers that join later are not checked."""
    workers = client.scheduler_info(n_workers=-1)["workers"].values()
    smallest = min((worker["memory_limit"] or float("inf") for worker in workers), default=float("inf"))
    # a worker started with "--memory-limit 2GB" has 7% less than 2 GiB and is accepted
    if smallest < 0.93 * memory_limit * 2**30:
        raise UserError(
            f"{cluster_name}: a worker has {smallest / 2**30:.2f} GiB, run.memory_limit is {memory_limit:g}: "
            "start workers with --memory-limit, or lower run.memory_limit"
        )
    try:
        versions = set(client.run(_version).values())
    except (ImportError, AttributeError) as error:
        raise UserError(f"{cluster_name}: a worker cannot load romandask ({error}): install it there") from None
    if versions - {version("romandask")}:
        raise UserError(
            f"{cluster_name}: a worker has romandask {', '.join(sorted(versions))}, this is "
            f"{version('romandask')}: install the same everywhere"
        )


def _version() -> str:
    return version("romandask")


def _free_port(wanted: int) -> int:
    """Return the wanted port if it is free on the loopback interface, else 0 (any port)."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", wanted))
        except OSError:
            return 0
    return wanted
