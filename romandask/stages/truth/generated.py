"""The generated universe: matter on the sky, then galaxies and stars of one HEALPix cell at a time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd

from romandask.ingest.spectra import blackbodies, every_file, galaxy_templates, joined, read_folder
from romandask.kernels.universe import galaxies, galaxy_rows, milky_way_stars
from romandask.kernels.universe.bandpasses import rubin_bandpass
from romandask.kernels.universe.flux_table import FluxTable, flux_table
from romandask.kernels.universe.structure import FIELD_NAMES, MAX_REDSHIFT, Structure, bytes_of, shells, structure
from romandask.model.errors import UserError
from romandask.model.settings import TruthSettings
from romandask.model.sky import Region
from romandask.model.spectra import Bandpass, SpectrumLibrary
from romandask.products.hats import with_spatial_index
from romandask.products.images import Coordinates, ImageProduct
from romandask.products.units import Unit
from romandask.storage.arrays import Variable
from romandask.storage.manifest import digest
from romandask.storage.paths import AnyPath

_NO_BINS = np.zeros(0, np.float32)


@dataclass(frozen=True)
class Templates:
    """Spectra of generated galaxies and stars."""

    library: SpectrumLibrary
    galaxies: int
    """Number of spectra of galaxies, which come first in the library; the others are spectra of stars."""
    temperatures: np.ndarray
    """Colour temperatures of the spectra of stars, K."""


@lru_cache(maxsize=4)
def templates(star_folder: AnyPath | None) -> Templates:
    """Return the galaxy templates, followed by spectra of stars.

    Parameters
    ----------
    star_folder : path or None
        Folder of spectra of stars, whose temperatures are estimated from their colours; None for blackbodies.

    Raises
    ------
    UserError
        If no spectrum in the folder can be used.
    """
    galaxy_library = galaxy_templates(galaxies.TEMPLATES, galaxies.STEPS)
    bodies = blackbodies(milky_way_stars.TEMPERATURES)
    temperatures = np.array(milky_way_stars.TEMPERATURES, float)
    if star_folder is None:
        return Templates(joined(galaxy_library, bodies), len(galaxy_library.names), temperatures)
    stars, reasons = read_folder(star_folder, every_file(star_folder))
    # stars are observed in all bands, so a spectrum must cover u to F184
    full = [k for k, (low, high) in enumerate(stars.limits) if low < 305 and high > 2100]
    if not full:
        why = "; ".join(sorted(set(reasons.values()))) or "none reaches from 305 to 2100 nm"
        raise UserError(f"{star_folder}: no spectrum can be used ({why}); truth.star_seds must name a folder of stars")
    chosen = SpectrumLibrary(tuple(stars.names[k] for k in full), stars.wave, stars.photons[full], stars.limits[full])
    order = np.argsort(_redness(bodies))
    estimated = np.interp(_redness(chosen), _redness(bodies)[order], temperatures[order])
    return Templates(joined(galaxy_library, chosen), len(galaxy_library.names), estimated)


def _redness(library: SpectrumLibrary) -> np.ndarray:
    """Return the ratio of the mean photon densities in 700-800 nm and 450-500 nm, which decreases with temperature."""
    red = (library.wave > 700) & (library.wave < 800)
    blue = (library.wave > 450) & (library.wave < 500)
    return library.photons[:, red].mean(axis=1) / np.maximum(library.photons[:, blue].mean(axis=1), 1e-9)


def matter(settings: TruthSettings, region: Region, seed: int) -> ImageProduct:
    """Return the lazy matter and lensing fields around a region: one unit, with the dims (universe, shell, pixel).

    Parameters
    ----------
    settings : TruthSettings
        The `truth` section of the pipeline.
    region : Region
        Region that galaxies are generated in.
    seed : int
        Seed of the survey.
    """
    pixel_arcsec = np.degrees(np.sqrt(np.pi / 3) / settings.nside) * 3600
    order = int(np.log2(settings.nside))
    # the margin covers the hosts of satellites inside the region, and the neighbours that interpolation needs
    reach = settings.margin + 3 * galaxies.REACH + 2.5 * pixel_arcsec
    pixels = region.cells(order, reach)
    all_shells = shells()
    count = len(all_shells.planes)
    variables = tuple(
        Variable(
            name=name,
            dtype="float32",
            shape=(count, len(pixels)),
            axes=("shell", "pixel"),
            attributes={"units": "1", "long_name": text},
        )
        for name, text in zip(
            FIELD_NAMES,
            (
                "contrast of matter in a shell",
                "relative density of galaxies in a shell",
                "convergence of a source in a shell",
                "shear gamma_1 of a source in a shell",
                "shear gamma_2 of a source in a shell",
            ),
            strict=True,
        )
    )
    coordinates: Coordinates = {
        "pixel": (("pixel",), pixels, {"long_name": f"HEALPix pixel, nested, nside {settings.nside}"}),
        "z_edge": (("edge",), all_shells.edges, {"long_name": "redshifts between shells"}),
        "z_plane": (
            ("shell",),
            all_shells.planes,
            {"long_name": "redshift of sources for which convergence and shear hold"},
        ),
    }
    unit_settings = {"nside": settings.nside, "seed": seed, "pixels": digest(pixels)}
    return ImageProduct(
        stage="truth/structure",
        units=(Unit(name="all", settings=unit_settings),),
        make=_MakeMatter(settings.nside, tuple(pixels.tolist()), seed),
        variables=variables,
        axes=("universe",),
        lengths=(1,),
        coordinates=lambda: coordinates,
        attributes={"nside": settings.nside},
        # power spectra, then shells
        bytes_per_unit=max(160 << 20, bytes_of(settings.nside) + 10 * 4 * count * len(pixels)),
        seconds_per_unit=5 + 2e-4 * settings.nside**2,
    )


@dataclass(frozen=True)
class _MakeMatter:
    nside: int
    pixels: tuple[int, ...]
    seed: int

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        return _matter(self.nside, self.pixels, self.seed).fields


@lru_cache(maxsize=2)
def _matter(nside: int, pixels: tuple[int, ...], seed: int) -> Structure:
    return structure(nside, np.array(pixels, np.int64), seed)


@dataclass(frozen=True, kw_only=True)
class Generate:
    """Common base of the generators of galaxies and stars."""

    settings: TruthSettings
    region: Region
    bandpasses: dict[str, Bandpass]
    """Bandpasses of the survey, by band."""
    seed: int
    """Seed of the survey."""
    spectra: Templates
    cells: np.ndarray
    """HEALPix cells of the partitions, nested scheme, of order `settings.order`."""

    def inner_cells(self, index: int) -> np.ndarray:
        """Return the cells of order CELL_ORDER, each with its own random generators, of a partition and the region.

        They are the cells inside the partition that may touch the region.
        """
        depth = 2 * (galaxies.CELL_ORDER - self.settings.order)
        first = int(self.cells[index]) << depth
        wanted = self.region.cells(galaxies.CELL_ORDER, self.settings.margin)
        return wanted[(wanted >= first) & (wanted < first + (1 << depth))]

    def rows_of(self, index: int, frame: pd.DataFrame) -> pd.DataFrame:
        """Return the rows that lie in a partition and in the region, sorted by HEALPix cell."""
        inside = frame[self.region.contains(frame["ra"], frame["dec"], self.settings.margin)]
        located = with_spatial_index(inside)
        depth = 2 * (29 - self.settings.order)
        return located[(located["_healpix_29"].to_numpy() >> depth) == int(self.cells[index])]

    def all_bandpasses(self) -> tuple[Bandpass, ...]:
        """Return the bandpasses of the survey, followed by the others that the generator needs."""
        extra = [rubin_bandpass(band, 2, 1.0) for band in galaxy_rows.NEEDED_BANDS if band not in self.bandpasses]
        return (*self.bandpasses.values(), *extra)


@dataclass(frozen=True, kw_only=True)
class GenerateGalaxies(Generate):
    """Makes the galaxies of a partition."""

    matter: ImageProduct
    """Matter and lensing fields, from `matter`."""

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the rows of a partition (schema: catalogs/galaxies.yaml)."""
        fields, all_shells = self.matter.make, shells()
        assert isinstance(fields, _MakeMatter)
        field = Structure(
            fields.nside, np.array(fields.pixels), all_shells.edges, all_shells.planes, self.matter.load(0)
        )
        drawn = galaxies.draw(self._host_cells(index), self.seed, self.settings.galaxies, field)
        positions = pd.DataFrame({"ra": drawn.ra, "dec": drawn.dec, "row": np.arange(len(drawn.ra))})
        kept = self.rows_of(index, positions)
        frame = galaxy_rows.galaxy_rows(
            drawn.take(kept["row"].to_numpy()),
            field,
            self._flux_table(),
            tuple(self.bandpasses),
            self.settings.shear,
            self.settings.milky_way_av,
        )
        n = len(frame)
        bins: dict[str, Any] = {f"sed_val_{component}": [_NO_BINS] * n for component in ("bulge", "disk", "knots")}
        fluxes = {f"lsst_flux_{band}": np.full(n, np.nan, np.float32) for band in "ugrizy"}
        return frame.assign(_healpix_29=kept["_healpix_29"].to_numpy(), sed_extended=False, n_rows=0, **bins, **fluxes)

    def _host_cells(self, index: int) -> np.ndarray:
        """Return the cells whose galaxies or satellites may lie in a partition and in the region.

        They are the inner cells and the cells around them: hosts outside the region may have satellites inside, so that
        a smaller region has exactly the galaxies that a larger one has there.
        """
        inner = self.inner_cells(index)
        return galaxies.with_surroundings(inner) if len(inner) else inner

    def _flux_table(self) -> FluxTable:
        """Return the table of fluxes of the galaxy templates in all bands, from the cache if it is there."""
        frame = "rest" if self.settings.dust == "physical" else "observed"
        bands = self.all_bandpasses()
        library = self.spectra.library
        part = slice(0, self.spectra.galaxies)
        key = digest(frame, [b.name for b in bands], *[b.weights for b in bands], library.photons[part])
        if key not in _FLUX_TABLES:
            _FLUX_TABLES.clear()
            spectra = SpectrumLibrary(library.names[part], library.wave, library.photons[part], library.limits[part])
            _FLUX_TABLES[key] = flux_table(spectra, bands, frame, MAX_REDSHIFT + 0.02)
        return _FLUX_TABLES[key]


_FLUX_TABLES: dict[str, FluxTable] = {}
"""The last table of fluxes that this process made, by the hash of its inputs; all partitions of a survey share it."""


class GenerateStars(Generate):
    """Makes the stars of a partition."""

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the rows of a partition (schema: catalogs/stars.yaml)."""
        library = self.spectra.library
        frame = milky_way_stars.star_rows(
            self.inner_cells(index),
            self.seed,
            self.settings.stars,
            milky_way_stars.sightline(*self.region.centre),
            library,
            range(self.spectra.galaxies, len(library.names)),
            self.spectra.temperatures,
            self.all_bandpasses(),
            tuple(self.bandpasses),
            self.settings.milky_way_av,
        )
        fluxes = {f"lsst_flux_{band}": np.float32(np.nan) for band in "ugrizy"}
        return self.rows_of(index, frame).assign(n_rows=0, **fluxes)


class NoQuarantine:
    """Stands for the maker of the quarantine in a generated universe, which has no quarantined rows."""

    def __call__(self, index: int) -> pd.DataFrame:
        """Raise IndexError; it is never called because there are no units."""
        raise IndexError("the generator quarantines no rows")
