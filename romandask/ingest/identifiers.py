"""Identifiers of the objects of source catalogs: one rule for every format.

An identifier is an integer from 0 to 2^63 - 1. Its column may hold integers of any width, signed or not and with
missing values, decimals without fraction, or texts. A column of floats holds identifiers only if all its values are
whole and below 2^24 (single precision) or 2^53 (double precision); beyond, neighbouring integers are one float, so such
a column is refused. Negative integers are no identifiers, because -1 means "no object" in the tables of romandask.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath

MISSING = "id is missing"
"""Reason for the quarantine of a row without identifier."""
INTEGER = r"([+-]?[0-9]+)"
"""Pattern of identifiers that are texts."""
MAX_SHOWN = 40
"""Largest number of characters of a text that a reason quotes."""
_LARGEST = np.iinfo(np.int64).max
_SAFE_DIGITS = 18
"""Number of digits up to which every integer is an int64."""


@dataclass(frozen=True)
class Identifiers:
    """A column of identifiers."""

    values: np.ndarray
    """Identifiers as int64; -1 where there is none."""
    reason: np.ndarray
    """Why a row has no identifier, with the value that it has instead; "" where it has one."""

    def reason_after(self, reason: np.ndarray | str) -> np.ndarray:
        """Return the reasons for quarantine, with those of the identifiers added where there is none yet."""
        return np.where(np.asarray(reason, object) == "", self.reason, reason).astype(object)


def identifiers(values: np.ndarray, pattern: str = INTEGER, missing: np.ndarray | None = None) -> Identifiers:
    """Return a column of identifiers.

    Parameters
    ----------
    values : ndarray of number or str
        Values as read. Floats must have passed `check_floats`.
    pattern : str
        Regular expression that a text must match in full; its first group is the identifier.
    missing : ndarray of bool, optional
        Where the file says that there is no value. Texts without characters, None and NaN are missing as well.
    """
    values = np.asarray(values)
    missing = np.zeros(len(values), bool) if missing is None else np.asarray(missing, bool)
    if values.dtype.kind == "f":
        missing = missing | np.isnan(values)
        values = np.where(missing, 0, values).astype(np.int64)
    if values.dtype.kind in "iu":
        # a comparison of uint64 with int64 would be one of floats
        beyond = values > np.uint64(_LARGEST) if values.dtype == np.uint64 else np.zeros(len(values), bool)
        numbers = np.where(beyond, np.uint64(0), values).astype(np.int64) if beyond.any() else values.astype(np.int64)
        texts = values
    else:
        texts = np.array(["" if text is None or text != text else str(text).strip() for text in values], object)
        missing = missing | (texts == "")
        numbers, beyond = _parsed(texts, pattern)
    reason = np.full(len(values), "", object)
    for row in np.flatnonzero((beyond | (numbers < 0)) & ~missing):
        text = str(texts[row])
        shown = repr(text[:MAX_SHOWN]) if values.dtype.kind not in "iu" else text
        reason[row] = f"id {shown} is {_fault(text, pattern)}"
    reason[missing] = MISSING
    return Identifiers(np.where(reason == "", numbers, -1), reason)


def check_floats(path: AnyPath, column: str, values: np.ndarray) -> None:
    """Raise a UserError if a column of floats, of which `values` is a part, cannot hold identifiers."""
    digits = {2: 11, 4: 24}.get(values.dtype.itemsize, 53)
    known = values[~np.isnan(values)]
    bad = known[~(np.isfinite(known) & (known == np.floor(known)) & (np.abs(known) < 2.0**digits))]
    if len(bad):
        raise UserError(
            f"{path}: column {column!r} (for id) holds {float(bad[0])!r} as a {8 * values.dtype.itemsize}-bit float, "
            f"which is exact for integers below 2^{digits} alone: write identifiers as 64-bit integers or as text"
        )


def repeated_values(parts: list[np.ndarray]) -> np.ndarray:
    """Return the identifiers, sorted, that occur more than once in all parts together; negative ones are left out."""
    ids = np.concatenate(parts) if parts else np.empty(0, np.int64)
    ids.sort()
    values = np.unique(ids[1:][ids[1:] == ids[:-1]])
    return values[values >= 0]


def _parsed(texts: np.ndarray, pattern: str) -> tuple[np.ndarray, np.ndarray]:
    """Return texts as int64, 0 where that is impossible, and where it is."""
    if not len(texts):
        return np.empty(0, np.int64), np.empty(0, bool)
    found = pd.Series(texts, dtype=object).str.extract(f"^{pattern}$")[0]
    bad = found.isna().to_numpy(bool, copy=True)
    digits = found.fillna("0").to_numpy(object, copy=True)
    for row in np.flatnonzero(np.fromiter(map(len, digits), int, len(digits)) > _SAFE_DIGITS):
        magnitude = digits[row].lstrip("+-0") or "0"
        bad[row] = len(magnitude) > _SAFE_DIGITS + 1 or int(magnitude) > _LARGEST
        digits[row] = "0" if bad[row] else digits[row][:1].strip("+0123456789") + magnitude
    return digits.astype(str).astype(np.int64), bad


def _fault(text: str, pattern: str) -> str:
    """Return why a text or an integer is no identifier."""
    found = pd.Series([text], dtype=object).str.extract(f"^{pattern}$")[0]
    if found.isna()[0]:
        return "not an integer"
    return "negative" if found[0].startswith("-") else "above 2^63 - 1"
