"""Units that are lost with their worker while they are made, and why the worker ended."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from romandask.engine.graph import Key
from romandask.engine.staleness import Source

REASON_DELAY = 3.0
"""Time within which the reason why a worker ended becomes known after its end, s."""
EXIT_TOPIC = "romandask-worker-exit"
"""Topic of the events with the exit codes of worker processes."""
CONNECTION = "connection lost"
"""Reason of a lost worker of which no more is known."""


@dataclass(frozen=True)
class Lost:
    """A unit that was lost with its worker while it was made, and is made again."""

    source: Source
    """Stage and name of the unit."""
    reason: str
    """Why the worker ended: memory, a signal, or a lost connection."""


class Losses:
    """The losses that a cluster reported, with the reason as soon as it is known.

    Parameters
    ----------
    sources : mapping of Key to Source
        Units by the key of their task.
    """

    def __init__(self, sources: Mapping[Key, Source]):
        self._sources = sources
        self._lock = threading.Lock()
        self._waiting: list[tuple[float, str, Source]] = []
        """Time of the loss, worker and unit, of losses that have not been yielded."""
        self._reasons: dict[str, str] = {}
        """Reason by address of the worker."""

    def on_event(self, event: tuple[float, Any]) -> None:
        """Note the units of a worker that the scheduler has removed unexpectedly."""
        message = event[1]
        if not isinstance(message, dict) or message.get("action") != "remove-worker" or message["expected"]:
            return
        lost = [self._sources[key] for key in message["processing-tasks"] if key in self._sources]
        with self._lock:
            self._waiting += [(time.monotonic(), message["worker"], source) for source in lost]

    def on_memory(self, event: tuple[float, Any]) -> None:
        """Note a worker that its nanny ends because it uses too much memory."""
        message = event[1]
        with self._lock:
            self._reasons[message["worker"]] = f"memory: the worker used {message['rss'] / 2**30:.2f} GiB"

    def on_exit(self, event: tuple[float, Any]) -> None:
        """Note the exit code of a worker process."""
        worker, code = event[1]["worker"], event[1]["exitcode"]
        reason = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        with self._lock:
            self._reasons.setdefault(worker, reason)

    def known(self, wait: bool = True) -> Iterator[Lost]:
        """Yield the losses that have not been yielded.

        Parameters
        ----------
        wait : bool
            Keep a loss for up to `REASON_DELAY` seconds until its reason is known.
        """
        with self._lock:
            now, waiting = time.monotonic(), self._waiting
            ready = [
                (worker, source)
                for when, worker, source in waiting
                if worker in self._reasons or not wait or now - when > REASON_DELAY
            ]
            self._waiting = [loss for loss in waiting if loss[1:] not in ready]
            found = [Lost(source, self._reasons.get(worker, CONNECTION)) for worker, source in ready]
        yield from found


@contextmanager
def watched_workers(client: Any, sources: Mapping[Key, Source]) -> Iterator[Losses]:
    """Return a context manager with the losses of a cluster while it makes some units.

    Parameters
    ----------
    client : distributed.Client
        Client of the cluster.
    sources : mapping of Key to Source
        Units by the key of their task.
    """
    losses = Losses(sources)
    topics = {"all": losses.on_event, "worker-restart-memory": losses.on_memory, EXIT_TOPIC: losses.on_exit}
    for topic, handler in topics.items():
        client.subscribe_topic(topic, handler)
    try:
        yield losses
    finally:
        for topic in topics:
            client.unsubscribe_topic(topic)
