"""Calibration: the planes that exposures with the full model of a detector read."""

from __future__ import annotations

from romandask.model.errors import UserError
from romandask.products.images import ImageProduct
from romandask.stages.stage import Stage, SurveyContext


def build_calibration(context: SurveyContext, survey: str) -> ImageProduct:
    """Return the lazy calibrations of the detectors that an instrument's pointings use.

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
    units_known_after=("pointings", "truth/ingested"),
    unit="detector",
    summary="With the full detector model: the planes that exposures read, from calibration files or made up.",
)
