"""Truth catalogs: the generator, and the real skyCatalogs sample."""

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hats.io.validation import is_valid_catalog
from hats.loaders import read_hats

from romandask.formats import skycatalogs
from romandask.instruments.rubin import Rubin, RubinSettings
from romandask.kernels.universe import lensing
from romandask.model.config import TruthSettings
from romandask.model.errors import UserError
from romandask.model.sky import Region
from romandask.runtime.cluster import InProcess
from romandask.runtime.hats import write_catalog_files
from romandask.runtime.store import Store
from romandask.runtime.work import Task
from romandask.truth import truth

REGION = Region(53.0, 53.04, -40.03, -40.0)
BANDS = {band: Rubin(RubinSettings()).bandpass(band) for band in "gri"}
SAMPLE = Region(53.5, 56.3, -37.1, -34.2)


def made(order: int, **settings):
    return truth(TruthSettings(order=order, margin=0.0, **settings), Path("."), REGION, BANDS, 7)


def sample(shared, **settings):
    options = {"source": "skycatalogs", "path": "skycatalogs_sample", "seds": "seds", "order": 6} | settings
    return truth(TruthSettings(**options), shared, SAMPLE, BANDS, 1)


def test_rows_do_not_depend_on_partitions():
    coarse, fine = made(8).galaxies.all_rows(), made(11).galaxies.all_rows()
    columns = [name for name in coarse if not name.startswith("sed_val")]
    first, second = (frame.sort_values("galaxy_id", ignore_index=True)[columns] for frame in (coarse, fine))
    pd.testing.assert_frame_equal(first, second)
    assert coarse["galaxy_id"].is_unique


def test_the_source_density_and_the_magnitudes_are_the_surveys():
    frame = made(8).galaxies.all_rows()
    expected = 597.2 * REGION.area
    assert len(frame) == pytest.approx(expected, abs=5 * np.sqrt(expected))
    mag = 31.4 - 2.5 * np.log10(
        frame["flux_r"]
        / frame.pipe(lambda f: 1 / ((1 - f["convergence"]) ** 2 - f["shear_1"] ** 2 - f["shear_2"] ** 2))
    )
    assert mag.max() < 29.001, "r < 29 before magnification"
    slope = np.log10((mag < 28).sum() / (mag < 26).sum()) / 2
    assert slope == pytest.approx((2.475 - 1.84) / 2, abs=0.05)
    assert frame["redshift"].between(0, 3).all()
    assert frame["redshift"].median() == pytest.approx(1.1, abs=0.25)
    major, minor = frame["size_disk_true"], frame["size_minor_disk_true"]
    assert (major >= minor).all()
    assert (minor > 0).all()


def test_fluxes_are_positive_and_stars_are_there():
    catalogs = truth(TruthSettings(order=8, margin=0.0, stars=40), Path("."), REGION, BANDS, 7)
    stars = catalogs.stars.all_rows()
    assert len(stars) == pytest.approx(40 * REGION.area, abs=5 * np.sqrt(40 * REGION.area))
    assert (stars[["flux_g", "flux_r", "flux_i"]] > 0).all(axis=None)
    assert not set(stars["id"]) & set(catalogs.galaxies.all_rows()["galaxy_id"])


def test_convergence_and_shear_come_from_one_potential():
    """Kaiser-Squires: the divergence of the shear field gives the convergence, by finite differences of a fine grid."""
    step = 1 / 3600
    ra, dec = np.meshgrid(10 + np.arange(-1, 2) * step, np.arange(-1, 2) * step)
    kappa, g1, g2 = (value.reshape(3, 3) for value in lensing(ra.ravel(), dec.ravel(), np.full(9, 1.5), 3))
    # u runs west, v north: gradients of kappa are those of (g1_u + g2_v, g2_u - g1_v)
    d = 2 * step
    u = lambda f: -(f[1, 2] - f[1, 0]) / d  # noqa: E731
    v = lambda f: (f[2, 1] - f[0, 1]) / d  # noqa: E731
    assert u(kappa) == pytest.approx(u(g1) + v(g2), rel=0.02, abs=1e-4)
    assert v(kappa) == pytest.approx(u(g2) - v(g1), rel=0.02, abs=1e-4)


def test_catalogs_are_hats_that_hats_pandas_and_pyarrow_read(tmp_path):
    catalogs, store = made(10), Store(tmp_path)
    for product in (catalogs.galaxies, catalogs.stars):
        tasks = [Task(index, "", 1.0) for index in range(len(product.units))]
        records = [outcome.record for outcome in InProcess().run(product, tasks, store)]
        write_catalog_files(product, store)
        root = store.catalog(product.stage)
        assert is_valid_catalog(root, strict=True)
        rows = sum(record.rows for record in records)
        assert read_hats(root).catalog_info.total_rows == rows
        frame = pd.read_parquet(root / "dataset", filters=[("dec", ">", -40.015)])
        assert 0 < len(frame) < rows
        assert (frame["dec"] > -40.015).all()
        field = pq.read_schema(root / "dataset" / "_common_metadata").field("ra")
        assert field.metadata[b"unit"] == b"deg"
        assert field.metadata[b"ucd"]
    cone = read_hats(store.catalog("truth/galaxies")).filter_by_cone(53.02, -40.015, 5)
    assert len(cone.get_healpix_pixels()) < len(catalogs.galaxies.units)


def test_the_real_sample_reads_with_its_inf_and_nan(shared):
    catalogs = sample(shared)
    galaxies, stars, bad = (table.all_rows() for table in (catalogs.galaxies, catalogs.stars, catalogs.quarantine))
    assert np.isinf(galaxies["bulge_magnorm"]).any(), "inf magnorm: no such component"
    fluxes = galaxies[["flux_g", "flux_r", "flux_i"]].to_numpy()
    assert np.isfinite(fluxes).all()
    assert (bad["reason"] == "SED not in the library").sum() > 100
    assert len(galaxies) + len(stars) > 400
    assert (stars[["flux_g", "flux_r", "flux_i"]] > 0).all(axis=None)


def test_colours_of_the_real_sample_are_those_that_skycatalogs_gives(shared):
    """Fluxes of the published files (other throughputs): the same objects, the same colours to their scatter."""
    galaxies = sample(shared).galaxies.all_rows()
    reference = pd.concat(
        pd.read_parquet(shared / "skycatalogs_sample" / f"galaxy_flux_{pixel}.parquet") for pixel in (9683, 9556)
    )
    both = galaxies.merge(reference, on="galaxy_id")
    both = both[(both["lsst_flux_r"] > 1e-6) & (both["flux_r"] > 0)]
    assert len(both) > 200
    for band in "ri":
        ratio = 2.5 * np.log10(both[f"flux_{band}"] / both[f"lsst_flux_{band}"])
        assert (ratio - ratio.median()).std() < 0.12


def test_every_row_of_the_sample_is_out_or_in_quarantine(shared):
    whole = Region(0, 360, -90, 90)
    catalogs = truth(
        TruthSettings(source="skycatalogs", path="skycatalogs_sample", seds="seds", order=5), shared, whole, BANDS, 1
    )
    out = len(catalogs.galaxies.all_rows()) + len(catalogs.stars.all_rows())
    assert catalogs.source_rows == out + len(catalogs.quarantine.all_rows())
    files = [
        *(shared / "skycatalogs_sample").glob("galaxy_[0-9]*.parquet"),
        *(shared / "skycatalogs_sample").glob("pointsource_[0-9]*.parquet"),
    ]
    assert catalogs.source_rows == sum(pq.read_metadata(path).num_rows for path in files)


def copy_of_sample(shared, folder: Path, change) -> Path:
    """The sample's pixel 9683, with its galaxy table changed."""
    folder.mkdir()
    (folder / "skyCatalog.yaml").write_bytes((shared / "skycatalogs_sample/skyCatalog.yaml").read_bytes())
    table = pq.read_table(shared / "skycatalogs_sample/galaxy_9683.parquet")
    pq.write_table(change(table), folder / "galaxy_9683.parquet")
    return folder


def test_bad_rows_are_set_aside_with_their_reason(shared, tmp_path):
    def spoil(table):
        frame = table.to_pandas()
        frame.loc[0, "ra"] = np.nan
        frame.loc[1, "size_disk_true"] = -1
        frame.loc[2, "convergence"] = 1.2
        frame.loc[3, "MW_rv"] = 0.5
        frame.loc[5, "galaxy_id"] = frame.loc[4, "galaxy_id"]
        frame.at[6, "sed_val_disk"] = frame.loc[6, "sed_val_disk"][:5]
        return pa.Table.from_pandas(frame, schema=table.schema.remove_metadata())

    source = skycatalogs.open_source(copy_of_sample(shared, tmp_path / "s", spoil))
    cell = next(iter(source.galaxies))
    reasons = skycatalogs.read_galaxies(source, cell)["reason"]
    words = ["position", "size", "weak regime", "R_v", "", "duplicate", "bins"]
    for row, word in enumerate(words):
        assert word in reasons[row]
        assert (reasons[row] == "") == (word == "")


def test_a_missing_column_or_a_truncated_file_is_named(shared, tmp_path):
    folder = copy_of_sample(shared, tmp_path / "s", lambda table: table.drop_columns(["shear_2"]))
    with pytest.raises(UserError, match=r"galaxy_9683\.parquet: column 'shear_2' is missing"):
        skycatalogs.open_source(folder)
    path = folder / "galaxy_9683.parquet"
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(UserError, match=r"galaxy_9683\.parquet: not a complete Parquet file \(5000 bytes\)"):
        skycatalogs.open_source(folder)
    with pytest.raises(UserError, match="no such folder"):
        skycatalogs.open_source(tmp_path / "none")
