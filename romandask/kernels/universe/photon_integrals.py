"""Compiled integrals of spectra over channels, with dust.

All arrays over wavelength hold cells of the common grid in ln(wavelength), on which a redshift is a shift by a number
of cells, in general not whole. `synthetic_photometry` is the interface to these functions.

Many functions share these arguments:

- scale, shift : shape (n,); factor from relative to absolute photon densities (0 for an object without light), and
  ln(1 + z) in cells, of each object
- first, cells : index on the common grid of the first cell that the channels cover, and number of these cells
- in_av, in_ebv, in_a, in_b, in_first, rest_frame : A_V and E(B-V) (n,) of the internal dust; its extinction curve, and
  the index on the common grid of the first cell of the curve; whether it acts in the rest frame or the observed frame
- mw_av, mw_ebv, mw_a, mw_b : A_V and E(B-V) (n,) of the Milky Way dust, and its extinction curve at the cells
- starts, offsets, weights : first cell of each channel, counted from `first`; where the weights of each channel begin;
  weights of the cells of all channels, one channel after the other
- out : shape (3, n, channels); photon rates, of which rows without light stay 0. The first axis is ALL_DUST,
  INTERNAL_DUST, NO_DUST; if its length is 1, only the rates with all dust are computed.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from romandask.kernels.universe.dust import ALL_DUST, INTERNAL_DUST, NO_DUST, TAU_PER_MAG, exp_minus
from romandask.model.spectra import LOG_STEP


@njit(cache=True, nogil=True, error_model="numpy")
def _apply_dust(density, begin, end, av, ebv, a, b, base, fraction):
    """Multiply cells from `begin` to `end` by the transmission of dust.

    The extinction curve of cell j is interpolated between its cells base + j and base + j + 1, at `fraction`.
    """
    for j in range(begin, end):
        k = base + j
        extinction = av * (a[k] * (1 - fraction) + a[k + 1] * fraction) + ebv * (
            b[k] * (1 - fraction) + b[k + 1] * fraction
        )
        density[j] *= exp_minus(extinction * TAU_PER_MAG)


@njit(cache=True, nogil=True, error_model="numpy")
def _integrate(density, scale, starts, offsets, weights, out):
    """Write the photon rate of each channel to `out`."""
    for c in range(len(starts)):
        cells = density[starts[c] : starts[c] + offsets[c + 1] - offsets[c]]
        weight = weights[offsets[c] : offsets[c + 1]]
        # four sums at a time, because each addition waits for the one before
        one, two, three, four = 0.0, 0.0, 0.0, 0.0
        whole = len(weight) // 4 * 4
        for k in range(0, whole, 4):
            one += cells[k] * weight[k]
            two += cells[k + 1] * weight[k + 1]
            three += cells[k + 2] * weight[k + 2]
            four += cells[k + 3] * weight[k + 3]
        for k in range(whole, len(weight)):
            one += cells[k] * weight[k]
        out[c] = (one + two + three + four) * scale


@njit(cache=True, nogil=True, error_model="numpy")
def _integrate_with_dust(
    i,
    density,
    begin,
    end,
    shift,
    first,
    in_av,
    in_ebv,
    in_a,
    in_b,
    in_first,
    rest_frame,
    mw_av,
    mw_ebv,
    mw_a,
    mw_b,
    starts,
    offsets,
    weights,
    scale,
    out,
):
    """Write the photon rates of object `i`; applies dust to its photon densities in the cells begin to end."""
    every = out.shape[0] > 1
    if every:
        _integrate(density, scale[i], starts, offsets, weights, out[NO_DUST, i])
    if in_av[i] != 0:
        whole = np.floor(-shift[i]) if rest_frame else 0.0
        fraction = -shift[i] - whole if rest_frame else 0.0
        base = first - in_first + int(whole)
        dust_begin = max(begin, -base)
        dust_end = min(end, len(in_a) - 1 - base) if rest_frame else end - 1
        _apply_dust(density, dust_begin, dust_end, in_av[i], in_ebv[i], in_a, in_b, base, fraction)
        if not rest_frame:
            density[end - 1] *= np.exp(
                -TAU_PER_MAG * (in_av[i] * in_a[base + end - 1] + in_ebv[i] * in_b[base + end - 1])
            )
    if every:
        _integrate(density, scale[i], starts, offsets, weights, out[INTERNAL_DUST, i])
    if mw_av[i] != 0:
        _apply_dust(density, begin, end - 1, mw_av[i], mw_ebv[i], mw_a, mw_b, 0, 0.0)
        density[end - 1] *= np.exp(-TAU_PER_MAG * (mw_av[i] * mw_a[end - 1] + mw_ebv[i] * mw_b[end - 1]))
    _integrate(density, scale[i], starts, offsets, weights, out[ALL_DUST, i])


@njit(cache=True, nogil=True, error_model="numpy")
def library_rates(
    photons,
    photons_first,
    index,
    scale,
    shift,
    first,
    cells,
    in_av,
    in_ebv,
    in_a,
    in_b,
    in_first,
    rest_frame,
    mw_av,
    mw_ebv,
    mw_a,
    mw_b,
    starts,
    offsets,
    weights,
    out,
):
    """Write the photon rates of objects with spectra of a library.

    Parameters
    ----------
    photons : array, shape (spectra, cells of the library)
        Photon densities, 1 at 500 nm.
    photons_first : int
        Index on the common grid of the first cell of the library.
    index : int array, shape (n,)
        Spectrum of each object.
    """
    density = np.empty(cells)
    for i in range(len(scale)):
        if scale[i] == 0:
            continue
        whole = np.floor(-shift[i])
        fraction = -shift[i] - whole
        base = first - photons_first + int(whole)
        row = photons[index[i]]
        begin, end = min(max(0, -base), cells), max(0, min(cells, len(row) - 1 - base))
        density[:begin] = 0.0
        density[end:] = 0.0
        for j in range(begin, end):
            density[j] = row[base + j] * (1 - fraction) + row[base + j + 1] * fraction
        _integrate_with_dust(
            i,
            density,
            0,
            cells,
            shift,
            first,
            in_av,
            in_ebv,
            in_a,
            in_b,
            in_first,
            rest_frame,
            mw_av,
            mw_ebv,
            mw_a,
            mw_b,
            starts,
            offsets,
            weights,
            scale,
            out,
        )


@njit(cache=True, nogil=True, error_model="numpy")
def tophat_rates(
    flambda,
    beyond,
    edges,
    scale,
    shift,
    first,
    cells,
    in_av,
    in_ebv,
    in_a,
    in_b,
    in_first,
    rest_frame,
    mw_av,
    mw_ebv,
    mw_a,
    mw_b,
    starts,
    offsets,
    weights,
    out,
):
    """Write the photon rates of objects with top-hat spectra.

    The photon density of a cell is the mean over the cell of ``flambda * lambda`` in the bins and of
    ``beyond / lambda`` redward of the last bin.

    Parameters
    ----------
    flambda : array, shape (n, bins), 1/nm
        f_lambda of each bin, scaled so that a flat spectrum with the L_nu of the bin of 500 nm has a photon density of
        1 at 500 nm.
    beyond : array, shape (n,), nm
        Coefficient of the spectrum redward of the last bin.
    edges : array, shape (bins + 1,), nm
        Rest-frame edges of the bins.
    """
    density = np.empty(cells)
    bins = len(edges) - 1
    half = np.exp(LOG_STEP / 2)
    for i in range(len(scale)):
        if scale[i] == 0:
            continue
        first_bin = -1
        for j in range(cells):
            middle = np.exp((first + j - shift[i]) * LOG_STEP)
            low, high = middle / half, middle * half
            while first_bin < bins and edges[first_bin + 1] <= low:
                first_bin += 1
            total, start, k = 0.0, low, first_bin
            while start < high:
                stop = min(high, edges[k + 1]) if k < bins else high
                if k >= bins:
                    total += beyond[i] * np.log(stop / start)
                elif k >= 0:
                    total += flambda[i, k] * (stop * stop - start * start) / 2
                start = stop
                k += 1
            density[j] = total / (high - low)
        _integrate_with_dust(
            i,
            density,
            0,
            cells,
            shift,
            first,
            in_av,
            in_ebv,
            in_a,
            in_b,
            in_first,
            rest_frame,
            mw_av,
            mw_ebv,
            mw_a,
            mw_b,
            starts,
            offsets,
            weights,
            scale,
            out,
        )
