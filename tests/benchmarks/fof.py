"""Friends of friends against FoFCatalogMatching on the same objects, and of the paper's whole survey on a cluster.

python tests/benchmarks/fof.py            200,000 + 110,000 objects: same groups, and the ratio of the times
python tests/benchmarks/fof.py survey     12.6 + 7.0 million objects on 15.3 square degrees, on two workers

The first needs the peer: pip install FoFCatalogMatching
"""

import sys
import tempfile
import time
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import cdshealpix.nested as healpix
import numpy as np
import pandas as pd

from romandask.engine.clients import runner
from romandask.engine.graph import UnitGraph
from romandask.engine.runners import Ended
from romandask.kernels.measurement.groups import forest, label, links
from romandask.model.seeds import rng
from romandask.model.settings import MatchSettings
from romandask.model.sky import Region, cell_area, unit_vectors
from romandask.products.hats import with_spatial_index
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.analysis.friends_of_friends import matches
from romandask.storage.store import Store

REGION = Region(51.0, 56.0, -42.0, -38.0)
COUNTS = {"roman": 12_648_328, "rubin": 6_991_231}
"""Detected objects of Troxel et al. (2023), stars among them."""
ORDER = 8


def against_the_peer() -> None:
    peer_module = import_module("FoFCatalogMatching")
    random = np.random.default_rng(0)
    # the density of the survey's objects, and their pairs: a tenth lie within an arcsecond of another
    side = np.sqrt(310_000 / (sum(COUNTS.values()) / REGION.area)) / 60
    frames = {}
    for name, count in (("roman", 200_000), ("rubin", 110_000)):
        ra, dec = 53 + random.uniform(0, side, count) / np.cos(np.radians(40)), -40 + random.uniform(0, side, count)
        near = random.integers(0, count, count // 10)
        ra[: len(near)], dec[: len(near)] = ra[near], dec[near]
        frames[name] = pd.DataFrame(
            {
                "ra": ra + random.normal(0, 0.3 / 3600, count),
                "dec": dec + random.normal(0, 0.3 / 3600, count),
            }
        )
    every = pd.concat(frames.values())
    # compiled before it is timed
    forest(2, *links(unit_vectors(every["ra"][:2], every["dec"][:2]), 1.0))
    times = []
    for _ in range(3):
        start = time.perf_counter()
        vectors = unit_vectors(every["ra"], every["dec"])
        into, joined = forest(len(every), *links(vectors, 1.0))
        group = label(into, joined, 1.0)
        times.append(time.perf_counter() - start)
    start = time.perf_counter()
    found = peer_module.match(frames, 1.0)
    peer = time.perf_counter() - start
    found = found.to_pandas()
    place = found["row_index"].to_numpy() + np.where(found["catalog_key"] == "rubin", len(frames["roman"]), 0)
    theirs = np.empty(len(every), np.int64)
    theirs[place] = found["group_id"]
    pairs = pd.DataFrame({"ours": group, "theirs": theirs}).drop_duplicates()
    same = pairs["ours"].is_unique and pairs["theirs"].is_unique
    print(f"{len(every)} objects, {len(pairs)} groups, the same: {same}")
    print(f"FoFCatalogMatching {peer:.1f} s, ours {min(times):.2f} s: ratio {peer / min(times):.0f}")


@dataclass(frozen=True)
class Made:
    """Makes a partition of an object table at the survey's density, with its pairs."""

    name: str
    cells: tuple[int, ...]

    def __call__(self, index: int) -> pd.DataFrame:
        random = rng(1, "fof", self.name, self.cells[index])
        inside = self.cells[index]
        mean = COUNTS[self.name] / REGION.area * cell_area(ORDER)
        count = int(random.poisson(mean * 0.9))
        # random places of the cell: random cells of order 29 in it
        place = (inside << 2 * (29 - ORDER)) + random.integers(0, 1 << 2 * (29 - ORDER), count)
        lon, lat = healpix.healpix_to_lonlat(place.astype(np.uint64), 29)
        ra, dec = lon.to_value("deg"), lat.to_value("deg")
        near = random.integers(0, count, count // 9)
        ra = np.append(ra, ra[near] + random.normal(0, 0.5 / 3600, len(near)) / np.cos(np.radians(dec[near])))
        dec = np.append(dec, dec[near] + random.normal(0, 0.5 / 3600, len(near)))
        frame = with_spatial_index(pd.DataFrame({"coord_ra": ra, "coord_dec": dec}), "coord_ra", "coord_dec")
        frame = frame[frame["_healpix_29"].to_numpy() >> 2 * (29 - ORDER) == inside]
        frame = frame[REGION.contains(frame["coord_ra"], frame["coord_dec"])].reset_index(drop=True)
        blank = schema("samples", ("i",)).empty_table().to_pandas()
        frame["objectId"] = (np.int64(inside) << 24) + np.arange(len(frame))
        return frame.assign(**{name: np.zeros(len(frame), blank[name].dtype) for name in blank if name not in frame})


def whole_survey() -> None:
    cells = tuple(map(int, REGION.cells(ORDER)))
    units = tuple(Unit(f"{ORDER}-{cell}", cell) for cell in cells)
    tables = {
        name: TableProduct(
            stage=f"samples/{name}",
            units=units,
            make=Made(name, cells),
            schema=schema("samples", ("i",)),
            pixels=cells,
            order=ORDER,
        )
        for name in COUNTS
    }
    with tempfile.TemporaryDirectory() as folder, runner(2, 2.0) as execution:
        store = Store(Path(folder))

        def run(product: TableProduct) -> tuple[float, int, int]:
            start, rows, peak = time.perf_counter(), 0, 0
            for ended in execution.run(UnitGraph.of(product, store)):
                assert isinstance(ended, Ended)
                assert ended.result is not None, ended.failure
                rows, peak = rows + ended.result.rows, max(peak, ended.result.peak_bytes)
            return time.perf_counter() - start, rows, peak

        for name, table in tables.items():
            seconds, rows, _ = run(table)
            print(f"{name}: {rows} objects in {len(cells)} partitions, made in {seconds:.0f} s (not counted)")
        samples = {name: table.stored(store) for name, table in tables.items()}
        codes = {name: code for code, name in enumerate(tables)}
        made = matches(samples, codes, MatchSettings(), REGION, store)
        total = 0.0
        for product in vars(made).values():
            seconds, rows, peak = run(product)
            total += seconds
            print(f"{product.stage}: {rows} rows, {seconds:.1f} s, peak of a worker {peak / 2**30:.2f} GiB")
        print(f"together {total:.0f} s")


if __name__ == "__main__":
    whole_survey() if sys.argv[1:] == ["survey"] else against_the_peer()
