"""Detection of the objects of a field, and measurement of their shapes and of their fluxes in every band."""

from __future__ import annotations

import numpy as np
import pandas as pd
from astropy.wcs import WCS

from romandask.kernels.measurement.detected_objects import SATURATED_CORE, DetectedObjects, Part
from romandask.kernels.measurement.extract import detect, detect_peaks
from romandask.kernels.measurement.photometry import (
    aperture_fluxes,
    kron_fluxes,
    psf_fluxes,
    psf_half_light_radius,
)
from romandask.model.settings import DetectionSettings
from romandask.products.memory import release_free_memory
from romandask.stages.detections.field import Field, FieldNoise

EXTENDED = 1.15
"""Ratio of the half-light radius of an object to that of the PSF above which the object counts as extended."""


def detect_and_measure(field: Field, wcs: WCS, settings: DetectionSettings) -> tuple[pd.DataFrame, np.ndarray]:
    """Detect and measure the objects of a field.

    Parameters
    ----------
    field : Field
        Images in one or more bands: images from any program (`ArrayField`), or coadds (`tile_field`).
    wcs : astropy.wcs.WCS
        WCS of the images.
    settings : DetectionSettings
        Section `detections` of a pipeline.

    Returns
    -------
    objects : DataFrame
        One row per object: `label` (its number in the segmentation map), `coord_ra` and `coord_dec` (degrees), and
        the columns of catalogs/objects.yaml except identifiers and extinction.
    segmentation : ndarray, shape (ny, nx), int32
        Number of the object in whose isophote a pixel lies, y * nx + x + 1 for an object with its peak in the pixel
        (x, y); 0 for none.
    """
    noise = field.noise()
    detected, segments = find_objects(field, noise, settings)
    ra, dec = positions(detected, wcs)
    objects = measure(detected, field, noise, segments)
    return objects.assign(label=detected.label, coord_ra=ra, coord_dec=dec), segments


def find_objects(
    field: Field, noise: FieldNoise, settings: DetectionSettings, part: Part | None = None
) -> tuple[DetectedObjects, np.ndarray]:
    """Detect the objects of a field in its detection image.

    The memory of the detection image is released before the function returns, because photometry needs room for one
    band.

    Parameters
    ----------
    field : Field
    noise : FieldNoise
    settings : DetectionSettings
    part : Part, optional
        Place of the field in a larger image; by default it is the whole image.

    Returns
    -------
    objects : DetectedObjects
    segments : ndarray, shape (ny, nx), int32
        Segmentation map.
    """
    detection_image = field.detection(noise)
    if field.method == "median":
        detected, segments = detect(
            detection_image,
            threshold=settings.threshold,
            min_area=settings.min_area,
            levels=settings.deblend_levels,
            contrast=settings.deblend_contrast,
            min_snr=settings.min_snr,
            part=part,
        )
    else:
        detected, segments = detect_peaks(
            detection_image, settings.threshold, settings.min_area, settings.min_snr, part
        )
    del detection_image
    release_free_memory()
    return detected, segments


def positions(objects: DetectedObjects, wcs: WCS, corner: tuple[int, int] = (0, 0)) -> tuple[np.ndarray, np.ndarray]:
    """Return right ascension and declination of objects, (n,) each, degrees.

    `corner` are column and row of the first pixel of the field in the image of the WCS.
    """
    if not len(objects.x):
        return objects.x, objects.y
    return wcs.all_pix2world(objects.x + corner[0], objects.y + corner[1], 0)


def measure(objects: DetectedObjects, field: Field, noise: FieldNoise, segments: np.ndarray) -> pd.DataFrame:
    """Measure the shapes of objects, and their fluxes in every band.

    Parameters
    ----------
    objects : DetectedObjects
        Objects to measure; they may be a part of the objects in the segmentation map.
    field : Field
    noise : FieldNoise
    segments : ndarray, shape (ny, nx), int32
        Segmentation map of all objects of the field.

    Returns
    -------
    DataFrame
        Columns of catalogs/objects.yaml except identifiers, coordinates and extinction, one row per object.
    """
    scale = field.pixel_scale
    psf_radius = psf_half_light_radius(noise.psf) if noise.psf.any() else 1.0
    flags = objects.flags.copy()
    columns = {
        "x": objects.x,
        "y": objects.y,
        "ixx": objects.x2 * scale**2,
        "iyy": objects.y2 * scale**2,
        "ixy": objects.xy * scale**2,
        "kron_radius": objects.kron_radius * np.sqrt(objects.a * objects.b) * scale,
        "half_light_radius": objects.half_light_radius * scale,
        "snr": objects.snr,
        "blendedness": objects.blendedness,
        "extendedness": (objects.half_light_radius > EXTENDED * psf_radius).astype(np.int8),
    }
    for band in field.bands:
        measurement = field.measurement(band, noise.bands[band])
        flux, error, flag = kron_fluxes(measurement, segments, objects)
        flags |= flag.astype(np.int32)
        columns[f"{band}_kronFlux"], columns[f"{band}_kronFluxErr"] = flux, error
        columns[f"{band}_apFlux"], columns[f"{band}_apFluxErr"] = aperture_fluxes(
            measurement, segments, objects, field.aperture / scale
        )
        columns[f"{band}_psfFlux"], columns[f"{band}_psfFluxErr"] = psf_fluxes(measurement, objects)
        # make room for the data quality plane
        del measurement
        flags[np.isin(objects.label, segments[field.saturated(band)])] |= SATURATED_CORE
    return pd.DataFrame(columns | {"flags": flags})
