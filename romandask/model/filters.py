"""Names of filters: the band that each name in observing sequences, OpSim databases and settings stands for.

A new name of a filter is one entry of `ROMAN` or `RUBIN`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class FilterNames:
    """Names of the filters of one telescope. Upper and lower case are the same in all of them."""

    synonyms: Mapping[str, tuple[str, ...]]
    """Other names of each band, by band."""
    others: tuple[str, ...]
    """Elements of the filter wheel that are not bands: dispersers, and positions for calibration."""
    around: str
    """Pattern of what may stand before or after the name of a filter, or of several such parts."""

    def find(self, name: str, bands: Collection[str] = ()) -> str | None:
        """Return the band of a name, or None if the name is not that of a band.

        Parameters
        ----------
        name : str
            Name of the filter in a file or a setting.
        bands : collection of str
            Bands that need not be in `synonyms`.
        """
        if name in bands or name in self.synonyms:
            return name
        bare = re.sub(self.around, "", name.strip(), flags=re.IGNORECASE).lower()
        return next((band for band, names in self.synonyms.items() if bare in _lower(band, *names)), None)

    def is_other(self, name: str) -> bool:
        """Return whether a name is that of an element that is not a band."""
        return re.sub(self.around, "", name.strip(), flags=re.IGNORECASE).lower() in _lower(*self.others)

    def known(self, bands: Collection[str] = ()) -> str:
        """Return all bands with their other names, as text for messages."""
        listed = [f"{band} ({', '.join(names)})" if names else band for band, names in self.synonyms.items()]
        return ", ".join([*(band for band in bands if band not in self.synonyms), *listed])


ROMAN = FilterNames(
    synonyms={
        "R062": ("F062", "R"),
        "Z087": ("F087", "Z"),
        "Y106": ("F106", "Y"),
        "J129": ("F129", "J"),
        "W146": ("F146", "W", "W149", "F149"),
        "H158": ("F158", "H"),
        "F184": ("F",),
        "K213": ("F213", "K"),
    },
    others=(
        *("prism", "snprism", "p127", "grism", "grism0", "grism1", "grism_0thorder", "grism_1storder", "g150"),
        *("dark", "none", "not_configured", "engineering", "unknown"),
    ),
    around=r"^(?:(?:roman|wfirst|wfi)[ _.:/-]*)+",
)
"""Roman's bands by GalSim's names, with the mission's official names, their letters, and older names."""
RUBIN = FilterNames(
    synonyms={
        "u": ("LSST_u", "u_24"),
        "g": ("LSST_g", "g_6"),
        "r": ("LSST_r", "r_57"),
        "i": ("LSST_i", "i_39"),
        "z": ("LSST_z", "z_20"),
        "y": ("LSST_y", "y_10", "y4", "y3"),
    },
    others=("white", "none", "empty", "unknown", "other", "dark", "diffuser", "pinhole", "ph", "vr"),
    around=r"^(?:(?:rubin|lsst(?:com)?(?:cam)?(?:20\d\d)?|comcam(?:sim)?)[ _.:/-]*)+"  # LSST_g, lsstcam-g, lsst2023-g
    r"|[_ ](?:sim_)?\d+(?:\.\d+)?$"  # the pieces of glass g_57 and g_sim_1.4
    r"|[ _-]band$",
)
"""Rubin's bands; the names of pieces of glass are those of the band with a number."""
TELESCOPES: Mapping[str, FilterNames] = {"roman": ROMAN, "rubin": RUBIN}
"""Names of filters by telescope."""


def any_band(name: str) -> str:
    """Return the band, of any telescope, that a name stands for.

    A name that is not known, or that stands for bands of two telescopes, is returned unchanged.
    """
    if any(name in names.synonyms for names in TELESCOPES.values()):
        return name
    found = [band for names in TELESCOPES.values() if (band := names.find(name))]
    return found[0] if len(found) == 1 else name


def keys_by(find: Callable[[str], str | None]) -> Callable[[Any], Any]:
    """Return a validator of mappings from names of filters, which puts the band in place of each name.

    Parameters
    ----------
    find : callable
        Returns the band of a name, or None if it does not know the name, which then stays as it is.
    """

    def validator(content: Any) -> Any:
        if not isinstance(content, dict):
            return content
        result: dict[Any, Any] = {}
        for key, value in content.items():
            band = (find(key) if isinstance(key, str) else None) or key
            if band in result:
                raise ValueError(f"{band} is there twice, the second time as {key!r}")
            result[band] = value
        return result

    return validator


def _lower(*names: str) -> set[str]:
    return {name.lower() for name in names}
