"""The sharp and the blended survey, between which unrecognised blends are counted."""

from __future__ import annotations

from dataclasses import dataclass

from romandask.model.errors import UserError
from romandask.stages.stage import SurveyContext


@dataclass(frozen=True)
class BlendPair:
    """Names of the two surveys between which unrecognised blends are counted."""

    sharp: str
    """Survey that resolves several objects where the other detects one."""
    blended: str
    """Survey whose objects may be unrecognised blends."""


def blend_pair(context: SurveyContext) -> BlendPair | None:
    """Return the two surveys whose blends are counted; None if the survey has only one of them.

    They are the surveys of the setting `matches.surveys`. If it is not set, they are the instruments whose
    `blend_role` is `sharp` and `blended`.

    Raises
    ------
    UserError
        If `matches.surveys` does not name two different instruments of the pipeline.
    """
    wanted, instruments = context.pipeline.matches.surveys, context.instruments
    if wanted is not None:
        if set(wanted) - set(instruments) or wanted[0] == wanted[1]:
            raise UserError(
                f"matches.surveys: {', '.join(wanted)}: two different ones of {', '.join(instruments)} are needed"
            )
        return BlendPair(*wanted)
    by_role = {
        instrument.blend_role: name for name, instrument in instruments.items() if instrument.blend_role is not None
    }
    return BlendPair(by_role["sharp"], by_role["blended"]) if {"sharp", "blended"} <= set(by_role) else None


def joint(context: SurveyContext) -> BlendPair:
    """Return the two surveys whose blends are counted.

    Raises
    ------
    UserError
        If the survey has only one of them, or `blend_pair` raises it.
    """
    pair = context.once(blend_pair)
    if pair is None:
        raise UserError(f"blends need a sharp and a blended survey; this one has {', '.join(context.instruments)}")
    return pair


def has_joint_analysis(context: SurveyContext, survey: str) -> bool:
    """Return whether a survey has both instruments whose blends are counted (the `exists` of stages)."""
    return context.once(blend_pair) is not None
