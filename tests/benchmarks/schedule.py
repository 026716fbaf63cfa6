"""The graph of a stored survey on 1 to 32 workers, with units that only wait as long as they took to make.

python tests/benchmarks/schedule.py STORE [time scale, 0.2] [numbers of workers, 1 2 4 8 16 32]

dask's scheduler gets the real graph of the survey as if nothing were made. A unit sleeps for the seconds of its record,
times the scale. Efficiency is the sum of all units' times over the number of workers times the time of the run; the
critical path is the longest chain of units.
"""

import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import dask
import yaml
from distributed import Client, LocalCluster

from romandask.engine.graph import UnitGraph
from romandask.engine.runners import Ended, OnCluster
from romandask.model.resources import resource_folder
from romandask.products.units import Made
from romandask.storage.manifest import read_records
from romandask.storage.store import Store
from romandask.survey import Survey, open_survey
from romandask.survey_graph import unit_graph


@dataclass(frozen=True)
class Sleeper:
    """A product whose units take as long as they took, and make nothing."""

    stage: str
    names: tuple[str, ...]
    seconds: Mapping[str, float]
    """Time of each unit by name, s."""
    bytes_per_unit: int = 0

    def prepare(self, store: Store) -> None:
        pass

    def write(self, index: int, store: Store) -> Made:
        time.sleep(self.seconds[self.names[index]])
        return Made(self.names[index], 0, 0)


def recorded(store: Store) -> dict[tuple[str, str], float]:
    """Return the seconds of every stored unit by stage and name."""
    return {
        (stage, name): record.seconds
        for stage in store.stages()
        for name, record in read_records(store, stage)
        if record is not None
    }


def critical_path(graph: UnitGraph, seconds: Mapping[tuple[str, str], float]) -> float:
    """Return the length of the longest chain of units, s."""
    ends: dict[tuple[str, str], float] = {}
    for stage in graph.stages:
        for name in stage.tasks:
            source = (stage.product.stage, name)
            ends[source] = seconds[source] + max((ends[other] for other in stage.sources[name]), default=0.0)
    return max(ends.values())


def sleeping(graph: UnitGraph, seconds: Mapping[tuple[str, str], float], store: Store) -> UnitGraph:
    """Return a graph whose units only sleep, in another store."""
    stages = []
    for stage in graph.stages:
        name = stage.product.stage
        times = {unit: seconds[name, unit] for unit in stage.tasks}
        stages.append(replace(stage, product=Sleeper(name, stage.product.names, times), finish=None))
    return UnitGraph(stages, store)


def wall_time(graph: UnitGraph, workers: int) -> float:
    """Return the time of a graph on some workers, which are threads of this process, s."""
    with (
        LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0", memory_limit=0
        ) as cluster,
        Client(cluster) as client,
    ):
        start = time.perf_counter()
        for ended in OnCluster(client, "").run(graph):
            assert isinstance(ended, Ended)
            assert ended.result is not None, ended.failure
        return time.perf_counter() - start


def main(path: str, scale: float, numbers: list[int]) -> None:
    stored = open_survey(path)
    assert stored.store is not None
    seconds = recorded(stored.store)
    settings = yaml.safe_load((resource_folder("pipelines") / "cluster" / "workers.yaml").read_text())
    with tempfile.TemporaryDirectory() as name, dask.config.set(dask.config.merge(dask.config.config, settings)):
        survey = Survey(stored.pipeline, Store(Path(name) / "empty"))
        graph = unit_graph(survey)
        work = sum(seconds[stage.product.stage, unit] for stage in graph.stages for unit in stage.tasks)
        longest = critical_path(graph, seconds)
        print(f"{len(graph)} units, {work:.0f} s of work, critical path {longest:.1f} s; time scale {scale:g}")
        for count in numbers:
            scaled = {source: value * scale for source, value in seconds.items()}
            took = wall_time(sleeping(graph, scaled, Store(Path(name) / str(count))), count) / scale
            best = max(longest, work / count)
            print(
                f"{count:3d} workers: {took:7.1f} s, efficiency {work / count / took:.2f}; "
                f"{best / took:.2f} of the best possible"
            )


if __name__ == "__main__":
    given = sys.argv[2:]
    main(sys.argv[1], float(given[0]) if given else 0.2, [int(word) for word in given[1:]] or [1, 2, 4, 8, 16, 32])
