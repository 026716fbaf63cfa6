"""Rubin's bands: constants of each filter that are not in GalSim's throughputs. A new band is one entry of `BANDS`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

COLLECTING_AREA = np.pi / 4 * 642.3**2
"""Effective collecting area of the telescope, cm2."""


@dataclass(frozen=True, kw_only=True)
class RubinBand:
    """One filter of the LSST camera."""

    name: str
    """Name of the filter."""
    effective_wave: float
    """Effective wavelength, nm."""
    visits: int
    """Mean number of visits of a point in five years of the wide-fast-deep survey."""
    depth_30s: float
    """5-sigma depth m5 of 30 s at zenith, with a sky of 21 mag / arcsec2 and FWHMeff of 0.7 arcsec, AB mag.

    The values are rubin_scheduler's SysEngVals (syseng_throughputs 1.7), with which OpSim's runs up to version 3.2 were
    made. Ivezic et al. (2019, table 2) give 23.09, 24.42, 24.44, 24.32, 24.16, 23.73 for ugrizy; SMTN-002 (throughputs
    1.9, three silver mirrors) gives 22.97, 24.58, 24.60, 24.54, 24.37, 23.84.
    """
    extinction: float
    """Atmospheric extinction k_m, mag per airmass (SysEngVals)."""
    read_loss: float
    """Loss of depth by the read noise of 30 s in the dark, mag; dC_m^inf of SMTN-002 (SysEngVals)."""
    dark_sky: float
    """Dark zenith sky at which `read_loss` holds, AB mag / arcsec2 (SysEngVals)."""
    airglow: float
    """Dark zenith sky of the generated cadence, AB mag / arcsec2.

    The values are from SMTN-002; those of u and z are from PSTN-054, table 3, because OpSim's sky model is brighter
    there.
    """
    sun: float
    """AB magnitude of the Sun (Willmer 2018)."""
    sun_limit: float
    """Altitude of the Sun above which the band is not used, degrees."""
    moonlight_choice: tuple[float, float, float, float]
    """Relative frequency with which the band is chosen at each value of `cadence.MOONLIGHT`, in units of its share of
    the visits.

    The values are set so that the median sky brightnesses are near those of OpSim's baseline 2.0 (PSTN-054, table 3:
    22.59, 21.98, 20.94, 20.01, 18.80, 18.20): u and g in the dark, z and y in moonlight and twilight.
    """


BANDS: dict[str, RubinBand] = {
    band.name: band
    for band in (
        RubinBand(
            name="u",
            effective_wave=365.5,
            visits=28,
            depth_30s=23.390261,
            extinction=0.502296,
            read_loss=0.371939,
            dark_sky=22.960730,
            airglow=22.68,
            sun=-25.30,
            sun_limit=-18.0,
            moonlight_choice=(1.0, 0.2, 0.0, 0.0),
        ),
        RubinBand(
            name="g",
            effective_wave=480.0,
            visits=40,
            depth_30s=24.506791,
            extinction=0.213738,
            read_loss=0.098515,
            dark_sky=22.257758,
            airglow=22.25,
            sun=-26.52,
            sun_limit=-18.0,
            moonlight_choice=(1.0, 0.4, 0.05, 0.0),
        ),
        RubinBand(
            name="r",
            effective_wave=622.2,
            visits=92,
            depth_30s=24.489914,
            extinction=0.125886,
            read_loss=0.051961,
            dark_sky=21.196590,
            airglow=21.2,
            sun=-26.93,
            sun_limit=-18.0,
            moonlight_choice=(1.0, 0.8, 0.4, 0.1),
        ),
        RubinBand(
            name="i",
            effective_wave=754.1,
            visits=92,
            depth_30s=24.372551,
            extinction=0.096182,
            read_loss=0.036845,
            dark_sky=20.477419,
            airglow=20.46,
            sun=-27.05,
            sun_limit=-15.0,
            moonlight_choice=(0.8, 1.0, 1.0, 1.0),
        ),
        RubinBand(
            name="z",
            effective_wave=868.2,
            visits=80,
            depth_30s=24.202753,
            extinction=0.068623,
            read_loss=0.024581,
            dark_sky=19.599578,
            airglow=19.43,
            sun=-27.07,
            sun_limit=-12.0,
            moonlight_choice=(0.2, 0.8, 1.5, 3.0),
        ),
        RubinBand(
            name="y",
            effective_wave=991.7,
            visits=80,
            depth_30s=23.769195,
            extinction=0.169504,
            read_loss=0.018609,
            dark_sky=18.610405,
            airglow=18.6,
            sun=-27.07,
            sun_limit=-12.0,
            moonlight_choice=(0.15, 0.6, 1.5, 4.0),
        ),
    )
}
"""Bands by name, in order of wavelength."""
REFERENCE_BAND = "i"
"""Band in which objects are counted and compared with the truth."""
COLOUR_BAND = "g"
"""Band for the colour of an object between its counterparts in Rubin and Roman."""
