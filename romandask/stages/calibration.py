"""Calibration planes of the detectors, which the full detector model of exposures reads."""

from __future__ import annotations

from romandask.model.errors import UserError
from romandask.products.images import ImageProduct
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext


def build_calibration(context: SurveyContext, survey: str) -> ImageProduct:
    """Return the lazy calibrations of the detectors that occur in the pointings of an instrument.

    Raises
    ------
    UserError
        If the instrument has no calibrations with these settings.
    """
    detectors = sorted(set(context.pointings(survey)["detector"].tolist()))
    product = context.instruments[survey].calibrations(detectors)
    if product is None:
        raise UserError("this survey has no calibrations: they belong to roman.detector: sca")
    return product


CALIBRATION = Stage(
    name="calibration",
    per_survey=True,
    build=build_calibration,
    exists=lambda context, survey: context.instruments[survey].calibrated,
    units_known_after=UNITS_FROM_POINTINGS,
    unit="detector",
    summary="Calibration planes of the full detector model, from calibration files or generated.",
)
