"""The generated universe: its matter on the sky, then galaxies and stars a HEALPix cell at a time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

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
from romandask.products.images import ImageProduct
from romandask.products.units import Unit
from romandask.storage.arrays import Variable
from romandask.storage.manifest import digest
from romandask.storage.paths import AnyPath

_NO_BINS = np.zeros(0, np.float32)


@dataclass(frozen=True)
class Templates:
    """The spectra of generated objects."""

    library: SpectrumLibrary
    galaxies: int
    """The first spectra are galaxies', the others stars'."""
    temperatures: np.ndarray
    """Of the stars' spectra, K."""


@lru_cache(maxsize=4)
def templates(star_folder: AnyPath | None) -> Templates:
    """Return the library: galaxy templates, then blackbodies or a folder of stars by their colour temperature.

    Raises
    ------
    UserError
        If the folder has no spectrum that can be used.
    """
    own = galaxy_templates(galaxies.TEMPLATES, galaxies.STEPS)
    bodies = blackbodies(milky_way_stars.TEMPERATURES)
    if star_folder is None:
        return Templates(joined(own, bodies), len(own.names), np.array(milky_way_stars.TEMPERATURES, float))
    stars, reasons = read_folder(star_folder, every_file(star_folder))
    # stars are seen through all bands: a spectrum must reach from u to F184
    full = [k for k, (low, high) in enumerate(stars.limits) if low < 305 and high > 2100]
    if not full:
        why = "; ".join(sorted(set(reasons.values()))) or "none reaches from 305 to 2100 nm"
        raise UserError(f"{star_folder}: no spectrum can be used ({why}); truth.star_seds must name a folder of stars")
    chosen = SpectrumLibrary(tuple(stars.names[k] for k in full), stars.wave, stars.photons[full], stars.limits[full])
    order = np.argsort(_redness(bodies))
    heat = np.interp(_redness(chosen), _redness(bodies)[order], np.array(milky_way_stars.TEMPERATURES, float)[order])
    return Templates(joined(own, chosen), len(own.names), heat)


def _redness(library: SpectrumLibrary) -> np.ndarray:
    """Return the mean photon density of 700-800 nm over that of 450-500 nm, a colour that falls with temperature."""
    red = (library.wave > 700) & (library.wave < 800)
    blue = (library.wave > 450) & (library.wave < 500)
    return library.photons[:, red].mean(axis=1) / np.maximum(library.photons[:, blue].mean(axis=1), 1e-9)


def matter(settings: TruthSettings, region: Region, seed: int) -> ImageProduct:
    """Return the matter of the region and what it does to galaxies: one unit, dims (universe, shell, pixel)."""
    pixel = np.degrees(np.sqrt(np.pi / 3) / settings.nside) * 3600
    order = int(np.log2(settings.nside))
    # satellites of hosts outside the region, and the neighbours that interpolation takes
    reach = settings.margin + 3 * galaxies.REACH + 2.5 * pixel
    pixels = region.cells(order, reach)
    every = shells()
    count = len(every.planes)
    planes = tuple(
        Variable(name, "float32", (count, len(pixels)), ("shell", "pixel"), {"units": "1", "long_name": text})
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
    coordinates = {
        "pixel": (("pixel",), pixels, {"long_name": f"HEALPix pixel, nested, nside {settings.nside}"}),
        "z_edge": (("edge",), every.edges, {"long_name": "redshifts between shells"}),
        "z_plane": (
            ("shell",),
            every.planes,
            {"long_name": "redshift of sources for which convergence and shear hold"},
        ),
    }
    state = {"nside": settings.nside, "seed": seed, "pixels": digest(pixels)}
    return ImageProduct(
        stage="truth/structure",
        units=(Unit("all", state),),
        make=_MakeMatter(settings.nside, tuple(pixels.tolist()), seed),
        variables=planes,
        axes=("universe",),
        lengths=(1,),
        coordinates=lambda: coordinates,
        attributes={"nside": settings.nside},
        bytes_per_unit=bytes_of(settings.nside) + 10 * 4 * count * len(pixels),
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


@dataclass(frozen=True)
class Generate:
    """What both catalogs are generated from."""

    settings: TruthSettings
    region: Region
    bandpasses: dict[str, Bandpass]
    seed: int
    spectra: Templates
    cells: np.ndarray
    """HEALPix cells of the partitions."""

    def inner_cells(self, index: int) -> np.ndarray:
        """Return the cells of randomness of a partition that may touch the region."""
        depth = 2 * (galaxies.CELL_ORDER - self.settings.order)
        first = int(self.cells[index]) << depth
        wanted = self.region.cells(galaxies.CELL_ORDER, self.settings.margin)
        return wanted[(wanted >= first) & (wanted < first + (1 << depth))]

    def mine(self, index: int, frame: pd.DataFrame) -> pd.DataFrame:
        """Return the rows of a partition and of the region, sorted by their place."""
        inside = frame[self.region.contains(frame["ra"], frame["dec"], self.settings.margin)]
        located = with_spatial_index(inside)
        depth = 2 * (29 - self.settings.order)
        return located[(located["_healpix_29"].to_numpy() >> depth) == int(self.cells[index])]

    def all_bandpasses(self) -> tuple[Bandpass, ...]:
        """Return the survey's bandpasses and those that the generator needs."""
        extra = [rubin_bandpass(band, 2, 1.0) for band in galaxy_rows.NEEDED_BANDS if band not in self.bandpasses]
        return (*self.bandpasses.values(), *extra)


@dataclass(frozen=True)
class GenerateGalaxies(Generate):
    """Makes the galaxies of a partition."""

    matter: ImageProduct

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the rows of a partition (catalogs/galaxies.yaml)."""
        source: _MakeMatter = self.matter.make  # type: ignore[assignment]
        every = shells()
        field = Structure(source.nside, np.array(source.pixels), every.edges, every.planes, self.matter.load(0))
        cells = self._cells_around(index)
        drawn = galaxies.draw(cells, self.seed, self.settings.galaxies, field)
        located = pd.DataFrame({"ra": drawn.ra, "dec": drawn.dec, "place": np.arange(len(drawn.ra))})
        kept = self.mine(index, located)
        frame = galaxy_rows.galaxy_rows(
            drawn.take(kept["place"].to_numpy()),
            field,
            self._table(),
            tuple(self.bandpasses),
            self.settings.shear,
            self.settings.milky_way_av,
        )
        n = len(frame)
        bins = {f"sed_val_{component}": [_NO_BINS] * n for component in ("bulge", "disk", "knots")}
        fluxes = {f"lsst_flux_{band}": np.full(n, np.nan, np.float32) for band in "ugrizy"}
        return frame.assign(_healpix_29=kept["_healpix_29"].to_numpy(), sed_extended=False, n_rows=0, **bins, **fluxes)

    def _cells_around(self, index: int) -> np.ndarray:
        """Return the cells whose galaxies may lie in the partition: its own that touch the region, and those around.

        Hosts outside the region have satellites inside: the region's edge is no edge of the universe.
        """
        own = self.inner_cells(index)
        return galaxies.with_surroundings(own) if len(own) else own

    def _table(self) -> FluxTable:
        frame = "rest" if self.settings.dust == "physical" else "observed"
        bands = self.all_bandpasses()
        library = self.spectra.library
        own = slice(0, self.spectra.galaxies)
        key = digest(frame, [b.name for b in bands], *[b.weights for b in bands], library.photons[own])
        if key not in _TABLES:
            _TABLES.clear()
            kept = SpectrumLibrary(library.names[own], library.wave, library.photons[own], library.limits[own])
            _TABLES[key] = flux_table(kept, bands, frame, MAX_REDSHIFT + 0.02)
        return _TABLES[key]


_TABLES: dict[str, FluxTable] = {}
"""The last table that this process made: all partitions of a survey share it."""


class GenerateStars(Generate):
    """Makes the stars of a partition."""

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the rows of a partition (catalogs/stars.yaml)."""
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
        return self.mine(index, frame).assign(n_rows=0, **fluxes)


class NothingSetAside:
    """The quarantine of a generated universe."""

    def __call__(self, index: int) -> pd.DataFrame:
        """Never called: there are no units."""
        raise IndexError("the generator sets no rows aside")
