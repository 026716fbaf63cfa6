"""The paper's survey through the real graphs with nothing made: what planning, submission and the manifest cost.

python tests/benchmarks/scale.py [settings, for example region.ra=[51.0, 52.0]]

Every unit of every stage of `troxel2023` is found, hashed, handed to two workers and recorded; only the work itself is
left out. What this takes is overhead: beside it stands the time that the plan projects for the work.
"""

import resource
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import cloudpickle

from romandask.pipeline import load_pipeline
from romandask.runtime.cluster import runner
from romandask.runtime.images import ImageProduct
from romandask.runtime.pending import pending
from romandask.runtime.store import Store
from romandask.runtime.tables import TableProduct
from romandask.runtime.units import Made
from romandask.runtime.work import Batch
from romandask.stages import plan, stages
from romandask.survey import Survey

WORKERS = 2


@dataclass(frozen=True)
class Nothing:
    """A product, as it is sent to workers, of which nothing is made."""

    product: ImageProduct | TableProduct
    stage: str
    names: tuple[str, ...]
    seconds_per_unit: float
    bytes_per_unit: int

    def write(self, index: int, store: Store) -> Made:
        return Made(self.names[index], 0, 0)


def main(overrides: list[str]) -> None:
    settings = load_pipeline("troxel2023", overrides)
    start = time.perf_counter()
    planned = {row.stage: row.hours for row in plan(Survey(settings))}
    print(f"plan: {time.perf_counter() - start:.0f} s")
    total, count = 0.0, 0
    print(f"{'stage':24s} {'units':>8s} {'found in':>9s} {'run in':>8s} {'a task':>9s} {'product':>9s}")
    with tempfile.TemporaryDirectory() as name, runner(WORKERS, settings.run.memory_limit) as execution:
        store = Store(Path(name))
        survey = Survey(settings, store)
        for stage in stages(survey):
            start = time.perf_counter()
            product = stage.product(survey)
            todo = pending(product, store)
            assert not todo.blocked, todo.blocked[:3]
            found = time.perf_counter() - start
            start = time.perf_counter()
            made = product
            if not stage.name.startswith("pointings/"):
                made = Nothing(product, product.stage, product.names, product.seconds_per_unit, product.bytes_per_unit)
            outcomes = list(execution.run(Batch(made, todo.tasks, store)))
            ran = time.perf_counter() - start
            failed = [outcome.failure for outcome in outcomes if outcome.record is None]
            assert not failed, failed[0]
            total, count = total + found + ran, count + len(outcomes)
            size = len(cloudpickle.dumps(product)) / 1e6
            each = 1000 * ran / max(1, len(outcomes))
            print(
                f"{stage.name:24s} {len(outcomes):8d} {found:7.1f} s {ran:6.1f} s {each:6.1f} ms {size:6.1f} MB",
                flush=True,
            )
    hours = sum(planned.values())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    share = total / 3600 / (hours / WORKERS)
    print(
        f"{count} units in {total / 60:.1f} min, {1000 * total / count:.1f} ms each; the work {hours:.0f} core hours "
        f"by the plan, overhead {share:.2%} on {WORKERS} workers; scheduler and driver {peak:.2f} GiB"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
