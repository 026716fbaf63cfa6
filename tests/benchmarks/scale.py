"""The paper's survey through the real graphs with nothing made: what planning, submission and the manifest cost.

python tests/benchmarks/scale.py [settings, for example region.ra=[51.0, 52.0]]

Every unit of every stage of `troxel2023` is found, hashed, handed to two workers and recorded; only the work itself is
left out. What this takes is overhead: beside it stands the time that the plan projects for the work.
"""

import resource
import sys
import tempfile
import time
from collections.abc import Generator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import cloudpickle
from rich.console import Console

from romandask import run as running
from romandask.engine import run_stages
from romandask.engine.clients import runner
from romandask.engine.graph import StageUnits, UnitGraph
from romandask.engine.lost_units import Lost
from romandask.engine.progress import Reporter
from romandask.engine.runners import Ended, Runner
from romandask.pipeline import load_pipeline
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct
from romandask.products.units import Made
from romandask.stages.truth import catalogs
from romandask.storage.paths import AnyPath
from romandask.storage.store import Store
from romandask.survey import Survey

WORKERS = 2


@dataclass(frozen=True)
class Nothing:
    """A product, as it is sent to workers, of which nothing is made."""

    product: ImageProduct | TableProduct
    stage: str
    names: tuple[str, ...]
    bytes_per_unit: int

    def prepare(self, store: Store) -> None:
        pass

    def write(self, index: int, store: Store) -> Made:
        return Made(self.names[index], 0, 0)


class Idle:
    """Runs units as a cluster does; of what is handed to it nothing is made, but for the pointings."""

    def __init__(self, runner: Runner):
        self._runner, self.description = runner, runner.description
        self.largest = 0
        """Size of the largest product that was sent to the workers, bytes."""

    def recording(self, path: AnyPath) -> AbstractContextManager[None]:
        return nullcontext()

    def run(self, graph: UnitGraph) -> Generator[Ended | Lost, None, None]:
        yield from self._runner.run(replace(graph, stages=[self._emptied(stage) for stage in graph.stages]))

    def _emptied(self, stage: StageUnits) -> StageUnits:
        product = stage.product
        self.largest = max(self.largest, len(cloudpickle.dumps(product)))
        if product.stage.startswith("pointings/"):
            return stage
        return replace(stage, product=Nothing(product, product.stage, product.names, product.bytes_per_unit))


def main(overrides: list[str]) -> None:
    settings = load_pipeline("troxel2023", overrides)
    start = time.perf_counter()
    planned = running.plan(Survey(settings))
    print(f"plan: {time.perf_counter() - start:.0f} s")
    # units without files have neither catalog files nor spectra
    run_stages.write_catalog_files = catalogs.write_spectra = lambda *_: None
    run_stages.catalog_metadata_files = catalogs.files_below = lambda *_: []
    with tempfile.TemporaryDirectory() as name, runner(WORKERS, settings.run.memory_limit) as execution:
        store, idle = Store(Path(name)), Idle(execution)
        store.prepare()
        start = time.perf_counter()
        summary = running.run(Survey(settings, store), idle, Reporter(Console()))
        total = time.perf_counter() - start
    assert not summary.failed, summary.failed[:3]
    hours, count = sum(row.hours for row in planned), sum(summary.made.values())
    assert count == sum(row.units for row in planned)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    share = total / 3600 / (hours / WORKERS)
    print(
        f"{count} units in {total / 60:.1f} min, {1000 * total / count:.1f} ms each; the work {hours:.0f} core hours "
        f"by the plan, overhead {share:.2%} on {WORKERS} workers; scheduler and driver {peak:.2f} GiB, "
        f"largest product {idle.largest / 1e6:.1f} MB"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
