"""Fluxes in ten bands against GalSim's SED.calculateFlux, object by object, in the same run: time and agreement.

python tests/benchmarks/photometry.py [number of objects]
"""

import sys
import time

import galsim
import numpy as np

from romandask.ingest.spectra import galaxy_templates
from romandask.kernels.universe.bandpasses import galsim_roman_bandpasses, roman_bandpass, rubin_bandpass
from romandask.kernels.universe.dust import ALL_DUST, Dust, transmission
from romandask.kernels.universe.flux_table import flux_table
from romandask.kernels.universe.synthetic_photometry import band_photons
from romandask.model.spectra import LibrarySpectra

NAMES = ("CWW_E", "CWW_Sbc", "CWW_Scd", "CWW_Im")
ROMAN = ("Y106", "J129", "H158", "F184")
SAMPLE = 300


def main(count: int) -> None:
    random = np.random.default_rng(0)
    library = galaxy_templates(NAMES, 1)
    bandpasses = (*(rubin_bandpass(band, 2, 3e5) for band in "ugrizy"), *(roman_bandpass(band, 2) for band in ROMAN))
    sed, z = random.integers(0, 4, count), random.uniform(0, 3, count)
    magnorm, own = random.uniform(20, 28, count), np.minimum(random.exponential(0.3, count), 2)
    outer, rv = random.uniform(0.02, 0.1, count), np.full(count, 3.1)

    start = time.perf_counter()
    table = flux_table(library, bandpasses, "rest", 3.02)
    print(f"table of {len(NAMES)} spectra: {time.perf_counter() - start:.1f} s")
    arguments = (magnorm, LibrarySpectra(library, sed), z, Dust(own, rv), Dust(outer, rv), bandpasses)
    few = tuple(value[:10] if isinstance(value, np.ndarray) else value for value in (magnorm, sed, z, own, outer))
    table.photons(*few)
    times = {}
    start = time.perf_counter()
    tabulated = table.photons(magnorm, sed, z, own, outer)
    times["table"] = (time.perf_counter() - start) / count
    start = time.perf_counter()
    integrated = band_photons(*arguments)
    times["integration"] = (time.perf_counter() - start) / count

    at_500 = galsim.Bandpass(galsim.LookupTable([499.95, 500.05], [1.0, 1.0], interpolant="linear"), "nm")
    at_500 = at_500.withZeropoint("AB")
    unit = [galsim.SED(f"{name}_ext_more.sed", "Ang", "flambda").withMagnitude(0, at_500) for name in NAMES]
    roman = galsim_roman_bandpasses()
    references = [galsim.Bandpass(f"LSST_{band}.dat", "nm") for band in "ugrizy"] + [roman[band] for band in ROMAN]
    # as a user would have the laws of dust, and as it takes for GalSim's trapezoids to be right to 1e-4 mag
    coarse = np.arange(60, 2601, 10.0)
    expected = np.empty((SAMPLE, len(references)))
    for name, inner_wave, outer_wave in (
        ("GalSim, dense dust", library.wave, np.arange(300, 2201, 1.0)),
        ("GalSim", coarse, np.arange(300, 2201, 10.0)),
    ):
        # the laws of dust themselves are not GalSim's time
        curves = [
            (transmission("CCM", inner_wave, own[row], 3.1), transmission("F19", outer_wave, outer[row], 3.1))
            for row in range(SAMPLE)
        ]
        start = time.perf_counter()
        for row in range(SAMPLE):
            inner, last = (
                galsim.SED(galsim.LookupTable(wave, curve, interpolant="linear"), "nm", "1")
                for wave, curve in zip((inner_wave, outer_wave), curves[row], strict=True)
            )
            spectrum = (unit[sed[row]] * 10 ** (-0.4 * magnorm[row]) * inner).atRedshift(z[row]) * last
            fluxes = [spectrum.calculateFlux(reference) for reference in references]
            if inner_wave is library.wave:
                expected[row] = fluxes
        times[name] = (time.perf_counter() - start) / SAMPLE
        print(f"{name}: {times[name] * 1e6:.0f} us an object and ten bands")
    expected *= [bandpass.area for bandpass in bandpasses]

    for name, found in (("table", tabulated), ("integration", integrated)):
        off = np.abs(2.5 * np.log10(found[ALL_DUST, :SAMPLE] / expected))
        print(
            f"{name}: {times[name] * 1e6:.2f} us an object and ten bands, GalSim {times['GalSim'] / times[name]:.0f} "
            f"times as long; differs by {off.max():.1e} mag at most, {np.median(off):.1e} in the median"
        )
    hours = 33e6 * 2 * times["table"] / 3600
    print(f"33 million galaxies of two components: {hours * 60:.1f} minutes of a core")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 400_000)
