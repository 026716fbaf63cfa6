"""The stored tiny survey through the public interface: products, objects and their agreement with the truth."""

import dask
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from astropy.io import fits
from conftest import command
from scipy.spatial import cKDTree

import romandask as rd
from romandask.export.truth import export_truth
from romandask.ingest.spectra import galaxy_templates
from romandask.instruments.exposure import exposure_of
from romandask.instruments.rubin.depth import depth_map, visit_depth
from romandask.kernels.measurement.extract import FLAGS
from romandask.kernels.universe.galaxies import STEPS, TEMPLATES
from romandask.model.sky import ARCSEC, unit_vectors
from romandask.run import run_figures
from romandask.stages.exposures.exposures import wcs_of
from romandask.stages.pointings import corners_of
from romandask.storage.store import Store


@pytest.fixture(scope="module")
def survey(tiny_store):
    with dask.config.set(scheduler="synchronous"):
        yield rd.open(tiny_store)


@pytest.fixture(scope="module")
def truth(survey):
    galaxies, stars = survey.truth("galaxies").compute(), survey.truth("stars").compute()
    return pd.concat([galaxies.assign(star=False), stars.assign(star=True)], ignore_index=True)


def test_a_rerun_finds_nothing_to_do(tiny_store):
    done = command("run", "tiny", "--store", "tiny", cwd=tiny_store.parent)
    assert done.returncode == 0
    assert "nothing to do" in done.stdout


def test_products_are_served_with_units(survey):
    coadds = survey.coadds("roman")
    assert dict(coadds["image"].sizes) == {"tile": 2, "band": 4, "y": 1000, "x": 1000}
    one = coadds.sel(band="H158").isel(tile=0)
    assert one["image"].attrs["units"] == "nJy"
    assert one["nimages"].max().compute() >= 5
    exposures = survey.exposures("roman")
    assert exposures["image"].chunks[0] == (1,) * exposures.sizes["exposure"]
    assert "coadds/roman" in repr(survey)
    assert survey.objects("rubin").columns.str.contains("i_psfFlux").any()


def test_the_stores_images_open_with_xarray_alone(tiny_store):
    dataset = xr.open_zarr(tiny_store / "coadds" / "rubin.zarr", consolidated=False)
    assert list(dataset["band"].values) == list("ugrizy")
    assert float(np.abs(dataset["image"].sel(band="i").isel(tile=0)).max()) > 0


def test_the_spectra_that_the_truth_names_are_stored(survey, tiny_store, truth):
    library = xr.open_zarr(tiny_store / "truth" / "seds.zarr", consolidated=False)
    used = truth["disk_sed"].dropna().astype(int)
    assert set(library["sed"].values[used.unique()]) <= set(galaxy_templates(TEMPLATES, STEPS).names)
    assert library["sed"].values[int(truth["sed"].dropna().iloc[0])].startswith("blackbody_")
    at_500 = library["photons"].interp(wave=500.0).values
    # samples are means over cells, which may contain a spectral line
    np.testing.assert_allclose(at_500, 1.0, rtol=2e-2)


def test_single_rubin_exposures_are_made_on_demand(survey):
    """Exposures are not stored if coadds are drawn from the cadence: the image is sky, objects and their noise."""
    dataset = survey.exposures("rubin").isel(exposure=0)
    image, truth, dq = dask.compute(*(dataset[name] for name in ("image", "truth", "dq")))
    exposure = exposure_of(survey.pointings("rubin").iloc[0])
    rubin = survey.instruments["rubin"]
    sky = rubin.background(exposure, rubin.header(exposure))
    pull = (image.values - truth.values - sky) / np.sqrt(
        np.maximum(truth.values + sky, 1) + rubin.detector.read_noise**2
    )
    good = dq.values == 0
    assert 0.99 < good.mean() < 1
    assert pull[good].mean() == pytest.approx(0, abs=0.01)
    # amplifiers differ by some per cent in their noise
    assert pull[good].std() == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize("name", ["roman", "rubin"])
def test_every_object_is_in_one_tile_and_in_the_region(survey, name):
    objects = survey.objects(name).compute()
    assert objects["objectId"].is_unique
    owner = survey.pipeline.coadds.grid().owner(objects["coord_ra"], objects["coord_dec"])
    names = {tile.id: tile.name for tile in survey.tiles}
    assert [names[value] for value in owner] == objects["tile"].tolist()
    assert survey.region.contains(objects["coord_ra"], objects["coord_dec"]).all()
    product = survey.output(f"detections/{name}")
    detections = pd.concat([product.load(k, ("objects",))["objects"] for k in range(len(product.units))])
    assert sorted(detections["objectId"]) == sorted(objects["objectId"])


def test_no_object_is_detected_by_two_tiles(survey):
    objects = survey.objects("roman").compute()
    first, second = (objects[objects["tile"] == tile.name] for tile in survey.tiles)
    gap, _ = cKDTree(unit_vectors(first["coord_ra"], first["coord_dec"])).query(
        unit_vectors(second["coord_ra"], second["coord_dec"])
    )
    assert gap.min() / ARCSEC > 0.1


def isolated_stars(truth, region, band, radius, tolerance):
    """Return the rows of bright true stars whose neighbours within a radius (arcsec) are faint, and all true fluxes."""
    flux = truth[f"flux_{band}"].to_numpy()
    vectors = unit_vectors(truth["ra"], truth["dec"])
    chosen = []
    for row in np.flatnonzero(truth["star"] & region.contains(truth["ra"], truth["dec"], -3.0)):
        gap = np.linalg.norm(vectors - vectors[row], axis=1) / ARCSEC
        # the wings of a bright neighbour reach further
        near = ((gap < radius) | ((gap < 3 * radius) & (flux > 0.1 * flux[row]))) & (gap > 0)
        if flux[near].sum() < tolerance * flux[row]:
            chosen.append(row)
    return np.array(chosen, int), flux


@pytest.mark.parametrize(("name", "radius"), [("roman", 0.6), ("rubin", 1.8)])
def test_magnitudes_of_isolated_bright_stars_agree_with_truth_in_every_band(survey, truth, name, radius):
    objects = survey.objects(name).compute()
    tree = cKDTree(unit_vectors(objects["coord_ra"], objects["coord_dec"]))
    for band in survey.instruments[name].bands:
        rows, flux = isolated_stars(truth, survey.region, band, radius, 0.02)
        gap, index = tree.query(unit_vectors(truth["ra"].iloc[rows], truth["dec"].iloc[rows]))
        measured = objects.iloc[index]
        value, error = measured[f"{band}_apFlux"].to_numpy(), measured[f"{band}_apFluxErr"].to_numpy()
        whole = (measured["flags"].to_numpy() & FLAGS["saturated"]) == 0
        bright = (gap / ARCSEC < 0.2) & (value > 20 * error) & (flux[rows] < 2e5) & whole
        assert bright.sum() >= 1, f"{band}: no isolated bright star"
        difference = -2.5 * np.log10(value[bright] / flux[rows][bright])
        # the errors do not include the light of neighbours, which the selection allows
        sigma = np.hypot(1.0857 * error[bright] / value[bright], 0.01)
        assert (np.abs(difference) < 3 * sigma).all(), (band, difference, sigma)
        # fits with the PSF of the tile centre agree to the few per cent by which the PSF varies with pixel phase
        fitted = -2.5 * np.log10(measured[f"{band}_psfFlux"].to_numpy()[bright] / flux[rows][bright])
        assert np.abs(np.median(fitted)) < 0.1


@pytest.mark.parametrize(("name", "limit"), [("roman", 0.05 * 0.0575), ("rubin", 0.05 * 0.2)])
def test_positions_of_isolated_stars_agree_to_a_twentieth_of_a_pixel(survey, truth, name, limit):
    objects = survey.objects(name).compute()
    band = {"roman": "H158", "rubin": "i"}[name]
    rows, flux = isolated_stars(truth, survey.region, band, 0.6, 0.05)
    rows = rows[(flux[rows] > 3000) & (flux[rows] < 3e5)]
    ra, dec = truth["ra"].to_numpy()[rows], truth["dec"].to_numpy()[rows]
    gap, _ = cKDTree(unit_vectors(objects["coord_ra"], objects["coord_dec"])).query(unit_vectors(ra, dec))
    assert len(rows) >= 1
    assert np.median(gap / ARCSEC) < max(limit, 0.004)


def test_noise_realisations_have_the_noise_of_the_images(survey):
    """Away from objects, image and noise have the same scatter: half the pixels of a Roman tile are that faint."""
    for name, band in (("roman", "F184"), ("rubin", "u")):
        tile = survey.coadds(name).sel(band=band).isel(tile=0)
        image, noise = tile["image"].values, tile["noise"].values
        low = image < np.median(image)
        below = np.sqrt(np.mean((image[low] - np.median(image)) ** 2))
        assert below == pytest.approx(noise.std(), rel=0.08)


def test_groups_hold_every_object_and_the_matrix_counts_them(survey):
    groups = survey.matches().compute()
    samples = {name: survey.sample(name).compute() for name in ("roman", "rubin")}
    counts = {name: len(frame) for name, frame in samples.items()}
    for name, band, limit in (("roman", "H158", 25.42), ("rubin", "i", 25.63)):
        objects = survey.objects(name).compute().set_index("objectId").loc[samples[name]["objectId"]]
        magnitude = 31.4 - 2.5 * np.log10(objects[f"{band}_kronFlux"]) - objects[f"{band}_extinction"]
        assert magnitude.max() <= limit
        assert ((objects["flags"] & ~(1 | 128)) == 0).all()
        assert 20 < len(objects) < len(survey.objects(name))
    assert groups["survey"].value_counts().to_dict() == counts
    for length in (1.0, 0.5):
        matrix = survey.statistics.blends(length)
        assert (matrix.sum(axis=1) * matrix.index).sum() == counts["roman"]
        assert (matrix.sum(axis=0) * matrix.columns).sum() == counts["rubin"]
    shorter = survey.matches(0.7).compute()
    tree = cKDTree(unit_vectors(groups["coord_ra"], groups["coord_dec"]))
    near = sum(len(found) - 1 for found in tree.query_ball_point(tree.data, 0.7 * ARCSEC)) // 2
    assert len(groups) - near <= shorter["group"].nunique() <= len(groups)
    assert shorter["group"].nunique() >= groups["group_1000mas"].nunique()
    for wrong in (3.0, 0.0):
        with pytest.raises(rd.UserError, match="linking length"):
            survey.matches(wrong)
    with pytest.raises(rd.UserError, match="linking length"):
        survey.statistics.blends(3.0)
    with pytest.raises(rd.UserError, match="roman, rubin"):
        survey.objects("euclid")


def test_rubins_depths_are_those_of_its_visits(survey):
    """Depths of point sources agree with the depths of the same visits (SMTN-002) within a tenth of a magnitude.

    In u GalSim's throughput is that of Ivezic et al. (2019, table 2), whose visits are 0.30 mag less deep.
    """
    visits, region = survey.pointings("rubin"), survey.region
    ra = region.ra_min + region.width * np.linspace(0, 1, 12)
    ra, dec = np.meshgrid(ra, np.linspace(region.dec_min, region.dec_max, 12))
    for band, depth in survey.depths("rubin").items():
        rows = visits[visits["band"] == band]
        of_visits = visit_depth(band, rows["seeing"], rows["airmass"], rows["sky_brightness"], rows["exptime"])
        expected = np.median(depth_map(ra.ravel(), dec.ravel(), corners_of(rows)[:, None], of_visits))
        assert depth == pytest.approx(expected - (0.30 if band == "u" else 0), abs=0.1), band


def test_differences_are_noise_but_for_the_colours_of_objects(survey):
    dataset, left = survey.differences(), survey.difference_residuals()
    assert dataset["difference"].dims == ("tile", "y", "x")
    assert set(left["objectId"]) <= set(survey.objects("rubin").compute()["objectId"])
    assert len(left) > 5
    for tile in range(dataset.sizes["tile"]):
        image, rms = (dataset[name].isel(tile=tile).values for name in ("difference", "rms"))
        seen = rms > 0
        assert 1.4826 * np.median(np.abs(image[seen] / rms[seen])) == pytest.approx(1, abs=0.15)
    # in pixels of 0.2 arcsec
    for axis in ("dx", "dy"):
        assert abs(left[axis].median()) < 0.1
    assert np.median(np.hypot(left["dx"], left["dy"])) < 0.1


def test_workers_lived_within_their_memory(tiny_store):
    assert max(row["peak_bytes"] for row in run_figures(Store(tiny_store))) < 2 * 2**30


@pytest.mark.parametrize("name", ["roman", "rubin"])
def test_bright_objects_are_found_and_real(survey, name):
    objects, matched = survey.objects(name).compute(), survey.truth_match(name).compute()
    assert sorted(matched["objectId"]) == sorted(objects["objectId"])
    summary = survey.truth_summary(name).compute()
    found = summary[summary["objectId"] > 0]
    assert set(found["objectId"]) <= set(objects["objectId"])
    assert (found["separation"] <= 1).all()
    counts = survey.completeness(name).set_index("magnitude")
    bright = counts.loc[19:23]
    assert bright["found"].sum() / bright["true"].sum() > 0.85
    assert bright["real"].sum() / bright["objects"].sum() > 0.95


def test_the_map_of_objects_has_the_objects_of_the_table(survey):
    segments = survey.segmentation("roman")["segmentation"].isel(tile=0).values
    objects = survey.output("detections/roman").load(0, ("objects",))["objects"]
    label = objects["objectId"].to_numpy() & 0xFFFFFF
    assert set(label) <= set(np.unique(segments))
    x, y = (np.rint(objects[name]).astype(int) for name in ("x", "y"))
    assert (segments[y, x] == label).mean() > 0.9


@pytest.mark.parametrize("name", ["roman", "rubin"])
def test_magnitudes_are_calibrated_on_stars(survey, name):
    zero = survey.output(f"zero_points/{name}").load(0)
    assert len(zero) == 3 * len(survey.instruments[name].bands)
    assert (np.abs(zero["offset"]) < 0.5).all()
    first = zero.iloc[0]
    column = f"{first['band']}_{first['flux']}"
    objects = survey.objects(name).compute().set_index("objectId")[column]
    product = survey.output(f"detections/{name}")
    measured = pd.concat([product.load(k, ("objects",))["objects"] for k in range(len(product.units))])
    measured = measured.set_index("objectId")[column]
    np.testing.assert_allclose(objects, measured.reindex(objects.index) * 10 ** (0.4 * first["offset"]), rtol=1e-5)


def test_the_psf_of_the_coadds_is_written_for_other_tools(survey, tiny_store, tmp_path):
    position = (53.03, -40.007)
    done = command("export", "coadd-psf", str(tiny_store), str(tmp_path), "--at", *map(str, position), "--band", "H158")
    assert done.returncode == 0, done.stderr
    (path,) = tmp_path.glob("*.fits")
    image, header = fits.getdata(path), fits.getheader(path)
    asked = survey.psf(*position, "H158")
    np.testing.assert_array_equal(image, asked.values)
    assert [header[f"EXP{k:05d}"] for k in range(len(asked.attrs["exposures"]))] == asked.attrs["exposures"]
    assert header["CRPIX1"] - 1 == pytest.approx(asked.attrs["x"])
    # the exposures are those of the set of the pixel at the position
    coadd = survey.coadds("roman").sel(band="H158")
    tile = int(np.flatnonzero(coadd["tile"].values == header["TILE"])[0])
    column, row = wcs_of(str(coadd["header"].values[tile])).all_world2pix(*position, 0)
    count = coadd["nimages"].isel(tile=tile, y=int(np.rint(row)), x=int(np.rint(column)))
    assert int(count) == len(asked.attrs["exposures"])
    wrong = command("export", "coadd-psf", str(tiny_store), str(tmp_path), "--at", "10", "10")
    assert wrong.returncode == 2
    assert wrong.stderr.startswith("error: (10.0, 10.0): outside the tiles")


@pytest.mark.parametrize("name", ["roman", "rubin"])
def test_extinction_is_what_the_milky_ways_dust_takes_from_the_counterparts(survey, name):
    joined, galaxies = survey.objects_with_truth(name), survey.truth("galaxies").compute()
    galaxies = joined[~joined["star"]].merge(galaxies, left_on="truth_id", right_on="galaxy_id")
    assert len(galaxies) > 50
    for band in survey.instruments[name].bands:
        dimming = -2.5 * np.log10(galaxies[f"flux_{band}_y"] / galaxies[f"flux_{band}_noMW"])
        # the extinction is that of a flat spectrum; in blue bands it depends on the colour by a few per cent
        middle = float(dimming.median())
        assert middle > 0
        assert np.median(galaxies[f"{band}_extinction"] - dimming) == pytest.approx(0, abs=0.05 * middle)


@pytest.mark.parametrize("name", ["roman", "rubin"])
def test_validation_agrees_with_the_noise_of_the_coadds(survey, name):
    """The depth is that of a matched filter on white noise, minus the effect of the correlation of the noise."""
    depth = survey.depths(name)
    assert np.isfinite(depth).all()
    for position, band in enumerate(survey.bands(name)):
        tile = survey.coadds(name).isel(tile=0, band=position)
        psf = tile["psf"].isel(patch_y=0, patch_x=0).values.astype(float)
        white = tile["noise"].values[0].std() / np.sqrt((psf**2).sum())
        ideal = 31.4 - 2.5 * np.log10(5 * white)
        assert -0.9 < depth[band] - ideal < 0.1
    table = survey.residuals(name)
    bright = table[table["magnitude"].between(20, 25) & (table["objects"] >= 5)]
    assert len(bright) >= 3
    assert bright["bias"].abs().median() < 0.2


def test_a_generated_survey_leaves_as_files_too(survey, tmp_path):
    paths = export_truth(survey, tmp_path)
    with fits.open(paths[0]) as hdus:
        assert len(hdus[1].data) > 500
        assert "sed_val_disk" not in hdus[1].columns.names
