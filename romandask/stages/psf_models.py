"""PSF models of detectors and bands: sampled once for all exposures whose PSF is the same, and read by their stages.

An instrument whose PSF differs between the visits has no such stage; its PSFs are computed where they are needed.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from typing import Any, Protocol, Self

import numpy as np
import pandas as pd

from romandask.instruments.exposure import Exposure, exposures_of
from romandask.instruments.instrument import Instrument
from romandask.instruments.psf_image import PSF_IMAGE_SIDE, centre_image
from romandask.kernels.rendering.psf import BrightPsf, NodeTransforms, PsfModel
from romandask.kernels.rendering.psf_layout import PsfLayout, arrays_of, model_of, padded, trimmed
from romandask.model.errors import UserError
from romandask.products.images import Coordinates, ImageProduct
from romandask.products.units import Unit
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext
from romandask.storage.arrays import Variable
from romandask.storage.store import Store

_FIRST_USES = 2
"""Exposures of a detector and band from which the PSF of the fainter bright stars is stored: making it takes as long as
to store it and read it twice. The PSFs of brighter stars, which fewer exposures show, are stored from four times as
many, each time."""
_AXES = {
    "layout": ("number",),
    "nodes": ("node", "row", "column"),
    "modes": ("mode", "core_row", "core_column"),
    "mixing": ("weight", "mode"),
    "peaks": ("mode",),
}
"""Axes of the arrays of a model, by name."""
_DTYPES = {"layout": "int32", "nodes": "complex64", "modes": "complex64", "mixing": "float32", "peaks": "float32"}
"""Dtypes of the arrays of a model, by name."""
_MEANINGS = {
    "layout": "size and folds of the grid, size of the core, degree, rows and columns of the detector, modes",
    "nodes": "transforms of the PSFs in the middle of the detector at the wavelengths of the band's nodes",
    "modes": "transforms of the modes of the variation with wavelength and position",
    "mixing": "weights of the modes of each node in the middle, then of each node at each position",
    "peaks": "largest surface brightness of each mode",
}
"""Descriptions of the arrays of a model, by name."""


class Psfs(Protocol):
    """The PSFs of the exposures of an instrument, as the stages take them."""

    def inputs(self, exposure: Exposure) -> tuple[tuple[str, str], ...]:
        """Return the (stage, unit) pairs that the PSF of an exposure is read from."""

    def model(self, exposure: Exposure) -> PsfModel:
        """Return the PSF of an exposure: see `Instrument.psf`."""

    def edges(self, exposure: Exposure) -> dict[int, float]:
        """Return the surface brightness of a unit star at the edges of stamps: see `Instrument.psf_edges`."""

    def bright(self, exposure: Exposure) -> tuple[BrightPsf, ...]:
        """Return the PSFs of bright stars: see `Instrument.bright_psfs`."""

    def centre(self, exposure: Exposure) -> np.ndarray:
        """Return the oversampled image of a star at the centre of the detector: see `centre_image`."""


@dataclass(frozen=True)
class ExposurePsfs:
    """PSFs that differ between exposures, computed where they are needed; implements `Psfs`."""

    instrument: Instrument

    def inputs(self, exposure: Exposure) -> tuple[tuple[str, str], ...]:
        """Return no units: the PSF is computed."""
        return ()

    def model(self, exposure: Exposure) -> PsfModel:
        """Return the PSF of an exposure."""
        return self.instrument.psf(exposure)

    def edges(self, exposure: Exposure) -> dict[int, float]:
        """Return the surface brightness of a unit star at the edges of stamps, by stamp size."""
        return self.instrument.psf_edges(exposure)

    def bright(self, exposure: Exposure) -> tuple[BrightPsf, ...]:
        """Return the PSFs of bright stars."""
        return self.instrument.bright_psfs(exposure)

    def centre(self, exposure: Exposure) -> np.ndarray:
        """Return the oversampled image of a star at the centre of the detector."""
        return centre_image(self.instrument, exposure)


@dataclass(frozen=True, kw_only=True)
class SharedPsfs:
    """PSFs of detectors and bands, read from a product or made by it; implements `Psfs`."""

    instrument: Instrument
    layout: PsfLayout
    stored_bright: tuple[int, ...]
    """Number of PSFs of bright stars in each unit; the others are made when they are needed."""
    product: ImageProduct
    """PSF models, one unit per detector and band."""

    def stored(self, store: Store) -> Self:
        """Return the same PSFs, reading what the store has."""
        return replace(self, product=self.product.stored(store))

    def inputs(self, exposure: Exposure) -> tuple[tuple[str, str], ...]:
        """Return the unit of the detector and band of an exposure."""
        return ((self.product.stage, _name(exposure)),)

    def model(self, exposure: Exposure) -> PsfModel:
        """Return the PSF of an exposure; that of the last detector and band is held by the process."""
        return _model(self._unit(exposure))

    def edges(self, exposure: Exposure) -> dict[int, float]:
        """Return the surface brightness of a unit star at the edges of stamps, by stamp size."""
        return _edges(self._unit(exposure))

    def bright(self, exposure: Exposure) -> tuple[BrightPsf, ...]:
        """Return the PSFs of bright stars, whose transforms are read, or made, one at a time."""
        unit, found = self._unit(exposure), self.instrument.bright_psfs(exposure)
        stored = self.stored_bright[unit.index]
        read = tuple(
            replace(psf, nodes=_Transforms(unit=unit, number=number, length=len(psf.nodes), shape=psf.grid.shape))
            for number, psf in enumerate(found[:stored])
        )
        return read + found[stored:]

    def centre(self, exposure: Exposure) -> np.ndarray:
        """Return the oversampled image of a star at the centre of the detector."""
        return _centre(self._unit(exposure))

    def _unit(self, exposure: Exposure) -> _UnitKey:
        store = self.product.store
        settings = json.dumps(self.instrument.psf_settings, sort_keys=True)
        key = (self.instrument.psf_key(exposure), settings, None if store is None else str(store.root))
        return _UnitKey(key, self, self.product.names.index(_name(exposure)))


@dataclass(frozen=True)
class _UnitKey:
    """A unit of PSF models, as the key of what a process holds: units with the same PSFs are equal."""

    key: tuple[Any, ...]
    psfs: SharedPsfs = field(compare=False)
    index: int = field(compare=False)

    def load(self, *names: str) -> dict[str, np.ndarray]:
        """Return arrays of the unit: read if it is stored, otherwise made."""
        return self.psfs.product.load(self.index, names)


@lru_cache(maxsize=1)
def _model(unit: _UnitKey) -> PsfModel:
    return model_of(unit.load(*_AXES))


@lru_cache(maxsize=128)
def _edges(unit: _UnitKey) -> dict[int, float]:
    sizes, brightness = unit.psfs.layout.edge_sizes, unit.load("edges")["edges"]
    return {size: float(value) for size, value in zip(sizes, brightness, strict=True)}


@lru_cache(maxsize=40)
def _centre(unit: _UnitKey) -> np.ndarray:
    return unit.load("centre")["centre"]


@dataclass(frozen=True, kw_only=True)
class _Transforms(NodeTransforms):
    """Transforms of the nodes of a PSF of bright stars; each is read, or made, when it is accessed."""

    unit: _UnitKey
    number: int
    """Number of the PSF, in increasing order of brightness."""
    length: int
    """Number of nodes."""
    shape: tuple[int, int]
    """Rows and columns of a transform."""

    def __len__(self) -> int:
        return self.length

    def transform(self, node: int) -> np.ndarray:
        """Return the transform of a node."""
        name = _bright_name(self.number, node)
        return trimmed(self.unit.load(name)[name], self.shape)


@dataclass(frozen=True)
class MakePsfModel:
    """Makes the PSF model of one detector and band."""

    instrument: Instrument
    layout: PsfLayout
    exposures: tuple[Exposure, ...]
    """An exposure of each detector and band; all others have the same PSF."""
    stored_bright: tuple[int, ...]
    """Number of PSFs of bright stars in each unit; the arrays of the others are 0."""

    def __call__(self, index: int) -> dict[str, Any]:
        """Return functions that return the arrays of a unit, by name; see `arrays_of`."""
        exposure, instrument = self.exposures[index], self.instrument
        sampled = _Sampled(instrument, exposure, self.layout)
        return {
            **{name: partial(sampled.take, name) for name in _AXES},
            "edges": lambda: np.array(list(instrument.psf_edges(exposure).values())),
            "centre": partial(centre_image, instrument, exposure),
            **{
                _bright_name(number, node): partial(_bright_transform, instrument, exposure, number, node, grid.shape)
                if number < self.stored_bright[index]
                else partial(np.zeros, grid.shape, np.complex64)
                for number, (nodes, grid) in enumerate(self.layout.bright[: max(self.stored_bright)])
                for node in range(nodes)
            },
        }


@dataclass(frozen=True, eq=False)
class _Sampled:
    """The PSF model of a unit, sampled when its first array is needed; each array can be taken once."""

    instrument: Instrument
    exposure: Exposure
    layout: PsfLayout

    @cached_property
    def _arrays(self) -> dict[str, np.ndarray]:
        return arrays_of(self.instrument.psf(self.exposure), self.layout)

    def take(self, name: str) -> np.ndarray:
        """Return an array, which is then no longer held."""
        return self._arrays.pop(name)


def _bright_transform(
    instrument: Instrument, exposure: Exposure, number: int, node: int, shape: tuple[int, int]
) -> np.ndarray:
    return padded(instrument.bright_psfs(exposure)[number].nodes[node], shape)


def _bright_name(number: int, node: int) -> str:
    return f"bright_{number}_{node}"


def _name(exposure: Exposure) -> str:
    """Return the name of the unit of the detector and band of an exposure."""
    return f"{exposure.band}-{exposure.detector}"


def psfs_for(instrument: Instrument, table: pd.DataFrame, calibration: ImageProduct | None = None) -> Psfs:
    """Return the PSFs of the exposures of a pointings table, outside a survey; for the parameters see `psf_models`."""
    layout = instrument.psf_layout
    return ExposurePsfs(instrument) if layout is None else psf_models(instrument, layout, table, calibration)


def psf_models(
    instrument: Instrument, layout: PsfLayout, table: pd.DataFrame, calibration: ImageProduct | None = None
) -> SharedPsfs:
    """Return the lazy PSF models of the exposures of a pointings table, one unit per detector and band.

    Parameters
    ----------
    instrument : Instrument
        Instrument of the exposures.
    layout : PsfLayout
        Its `psf_layout`.
    table : DataFrame
        Pointings table (schema: catalogs/pointings.yaml).
    calibration : ImageProduct, optional
        Calibrations of the detectors, which hold the diffusion of charge; None for a simple detector.
    """
    pairs = table.drop_duplicates(["detector", "band"]).sort_values(["band", "detector"])
    exposures = tuple(exposures_of(pairs))
    uses = table.groupby(["band", "detector"]).size().sort_index()
    stored_bright = tuple(sum(count >= _FIRST_USES * 4**k for k in range(len(layout.bright))) for count in uses)
    stored = replace(layout, bright=layout.bright[: max(stored_bright)])
    readout = instrument.readout(0, calibration)
    shared = {
        "instrument": instrument.name,
        "psf": instrument.psf_settings,
        "layout": [*stored.shapes.items(), *((nodes, grid.shape) for nodes, grid in stored.bright)],
    }
    units = tuple(
        Unit(
            name=_name(exposure),
            settings={**shared, "band": exposure.band, "detector": exposure.detector, "bright": bright},
            inputs=readout.inputs(exposure),
        )
        for exposure, bright in zip(exposures, stored_bright, strict=True)
    )
    axis = ("model",)

    def coordinates() -> Coordinates:
        return {
            "model": (axis, np.array([unit.name for unit in units], object), {}),
            "band": (axis, pairs["band"].to_numpy(object), {}),
            "detector": (axis, pairs["detector"].to_numpy(), {}),
        }

    bright_values = sum(nodes * int(np.prod(grid.shape)) for nodes, grid in stored.bright)
    largest = max([int(np.prod(grid.shape)) for _, grid in stored.bright], default=0)
    sampled = sum(int(np.prod(layout.shapes[name])) for name in ("nodes", "modes"))
    product = ImageProduct(
        stage=f"psf_models/{instrument.name}",
        units=units,
        make=MakePsfModel(instrument, layout, exposures, stored_bright),
        variables=_variables(stored),
        axes=axis,
        lengths=(len(units),),
        coordinates=coordinates,
        attributes={"survey": instrument.name, "pixel_scale": instrument.pixel_scale},
        bytes_per_unit=max(sampled * 32, largest * 70) + (100 << 20),
        seconds_per_unit=sampled * 1.5e-7 + bright_values * 2e-7,
    )
    return SharedPsfs(instrument=instrument, layout=layout, stored_bright=stored_bright, product=product)


def _variables(layout: PsfLayout) -> tuple[Variable, ...]:
    """Return the arrays of a unit."""

    def transforms(name: str, shape: tuple[int, ...], axes: tuple[str, ...], text: str, dtype: str) -> Variable:
        # random bits and large areas of zeros
        return Variable(name, dtype, shape, axes, {"long_name": text}, compress=False, zeros=True)

    model = [transforms(name, layout.shapes[name], _AXES[name], _MEANINGS[name], _DTYPES[name]) for name in _AXES]
    edges = {
        "units": "1/pixel",
        "long_name": "surface brightness of a unit star at the edges of stamps",
        "stamps": layout.edge_sizes,
    }
    centre = "unit star, flat f_nu, at the centre of the detector, share of light in a pixel centred on a sample"
    return (
        *model,
        Variable("edges", "float64", (len(layout.edge_sizes),), ("stamp",), edges),
        transforms("centre", (PSF_IMAGE_SIDE, PSF_IMAGE_SIDE), ("v", "u"), centre, "float32"),
        *(
            transforms(
                _bright_name(number, node),
                grid.shape,
                (f"bright_{number}_row", f"bright_{number}_column"),
                "transform of the PSF of bright stars in the middle of the detector; 0 if it is not stored",
                "complex64",
            )
            for number, (nodes, grid) in enumerate(layout.bright)
            for node in range(nodes)
        ),
    )


def build_psf_models(context: SurveyContext, survey: str) -> SharedPsfs:
    """Return the lazy PSF models of an instrument.

    Raises
    ------
    UserError
        If each exposure of the instrument has a PSF of its own.
    """
    instrument = context.instruments[survey]
    layout = instrument.psf_layout
    if layout is None:
        raise UserError(f"{survey}: each exposure has a PSF of its own: there are no PSF models to store")
    calibration = context.output(f"calibration/{survey}") if instrument.calibrated else None
    return psf_models(instrument, layout, context.pointings(survey), calibration)


def psfs_of(context: SurveyContext, survey: str) -> Psfs:
    """Return the PSFs of the exposures of an instrument: those of its stage, if it has this stage."""
    if context.instruments[survey].psf_layout is None:
        return ExposurePsfs(context.instruments[survey])
    psfs: Psfs = context.output(f"psf_models/{survey}")
    return psfs


PSF_MODELS = Stage(
    name="psf_models",
    per_survey=True,
    build=build_psf_models,
    exists=lambda context, survey: context.instruments[survey].psf_layout is not None,
    reads=("calibration",),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="detector and band",
    summary="PSFs in Fourier space at the wavelengths of a band, as they vary over a detector, and the larger ones of "
    "bright stars; only for instruments whose PSF is the same in all exposures of a detector and band (Roman).",
    shrink_with="leave out roman.bright_stars",
)
