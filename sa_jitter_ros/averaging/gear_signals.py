"""
What is left of a synchronous average when the regular gear vibration is taken out.

A healthy gear gives mesh harmonics, a few shaft orders and a few sidebands; a damaged tooth gives
all other orders too. With ``M`` the mesh orders, their harmonics, the first shaft orders and the
mean, and ``S`` the sidebands, the lines close to a mesh harmonic:

    regular    = M and S                     (as MATLAB's tsaregular with NumSidebands)
    difference = everything but M and S      (tsadifference)
    residual   = everything but M            (tsaresidual; the sidebands are kept)

so regular + difference is the average. An average over one revolution holds nothing but harmonics
of the shaft, so "shaft harmonics" can only mean the first few; two are customary. Stewart (1977)
introduced the signals; Lebold et al., "Review of vibration analysis methods for gearbox
diagnostics and prognostics", 54th MFPT (2000), fixed which indicator takes which.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sa_jitter_ros.errors import ParameterError, SignalError

Array = NDArray[Any]

# Far above any sensor, and its square is still far from overflow.
_LARGEST_SAMPLE = 1e100


@dataclass(frozen=True)
class GearSettings:
    """
    Which lines of an average are regular.

    `mesh_orders` are the tooth counts on the shaft of interest (one for each gear on it; none:
    unknown), `sidebands` the number of sideband pairs a mesh harmonic takes along, one order
    apart, `shaft_harmonics` the number of shaft orders. Raises ParameterError on a mesh order that
    is not a positive integer and on negative counts.
    """

    mesh_orders: Sequence[float] = ()
    sidebands: int = 1
    shaft_harmonics: int = 2

    def __post_init__(self) -> None:
        """Check the numbers and make them integers, the mesh orders a sorted tuple."""
        mesh_orders = np.unique(np.asarray(self.mesh_orders, float))
        for order in mesh_orders:
            if not (order >= 1.0 and order.is_integer()):
                raise ParameterError(
                    f'mesh order {order:g} is not a positive integer: an average over one '
                    'revolution holds whole orders only; give the tooth count of the gear')
        object.__setattr__(self, 'mesh_orders', tuple(int(order) for order in mesh_orders))
        for name in ('sidebands', 'shaft_harmonics'):
            count = float(getattr(self, name))
            if not (count >= 0.0 and count.is_integer()):
                raise ParameterError(f'{name} = {count:g}: give a whole number, 0 or more')
            object.__setattr__(self, name, int(count))


@dataclass(frozen=True)
class GearLines:
    """
    Which orders 0..n//2 of an average belong to what, as boolean masks.

    `mesh` are the mesh harmonics, `shaft` the mean and the shaft harmonics that are none of them,
    `sidebands` the neighbours of mesh harmonics that are neither. Around the mesh orders
    themselves, `fundamentals`, lie the `fundamental_sidebands`, up to `GearSettings.sidebands`
    orders away, and the `first_sidebands`, one order away whatever the settings.
    """

    mesh: Array
    shaft: Array
    sidebands: Array
    fundamentals: Array
    fundamental_sidebands: Array
    first_sidebands: Array


@dataclass(frozen=True)
class GearSignals:
    """
    An average taken apart: signals of its shape (..., n) and the peak amplitudes of its lines.

    `amplitudes` (..., n//2 + 1) is indexed by order and by the masks of `lines`.
    """

    regular: Array
    residual: Array
    difference: Array
    amplitudes: Array
    lines: GearLines


def gear_lines(settings: GearSettings, points: int) -> GearLines:
    """
    Return the lines of an average of so many points.

    Raises ParameterError on a mesh order at or above the Nyquist order, half the points.
    """
    for mesh_order in settings.mesh_orders:
        if 2 * mesh_order >= points:
            raise ParameterError(
                f'mesh order {mesh_order} is not below the Nyquist order {points / 2:g} of an '
                f'average of {points} points: use more samples per revolution')
    orders = np.arange(points // 2 + 1)
    tooth_counts = np.asarray(settings.mesh_orders, int)
    fundamentals = np.isin(orders, tooth_counts)
    mesh = (orders[:, None] % tooth_counts == 0).any(axis=1) & (orders > 0)
    shaft = (orders <= settings.shaft_harmonics) & ~mesh

    def neighbours(centres: Array, reach: int) -> Array:
        reach = min(reach, orders.size)
        kernel = np.ones(2 * reach + 1)
        near = np.convolve(centres, kernel)[reach:reach + orders.size] > 0.5
        return np.asarray(near & ~mesh & ~shaft)

    return GearLines(
        mesh=mesh, shaft=shaft, sidebands=neighbours(mesh, settings.sidebands),
        fundamentals=fundamentals,
        fundamental_sidebands=neighbours(fundamentals, settings.sidebands),
        first_sidebands=neighbours(fundamentals, 1))


def separate(average: ArrayLike, settings: GearSettings) -> GearSignals:
    """
    Take a synchronous average over one revolution, (..., n), apart into its gear signals.

    Raises SignalError on samples that are not finite and on an average that is empty or has one
    point, ParameterError on a mesh order at or above the Nyquist order n/2.
    """
    samples = np.asarray(average, float)
    if samples.size == 0 or samples.ndim == 0 or samples.shape[-1] < 2:
        raise SignalError(f'average of shape {samples.shape}: its last dimension is the angle and '
                          'needs 2 points or more, the others 1 or more')
    if not np.all(np.abs(samples) < _LARGEST_SAMPLE):
        raise SignalError(f'average with samples that are not finite or not below '
                          f'{_LARGEST_SAMPLE:g}: leave such averages out')
    points = samples.shape[-1]
    lines = gear_lines(settings, points)
    spectrum = np.fft.rfft(samples)
    # The mean and the Nyquist line of even n have no mirror image that holds half their amplitude.
    weight = np.full(spectrum.shape[-1], 2.0 / points)
    weight[0] = 1.0 / points
    if points % 2 == 0:
        weight[-1] = 1.0 / points
    difference = np.fft.irfft(
        np.where(lines.mesh | lines.shaft | lines.sidebands, 0.0, spectrum), points)
    return GearSignals(
        regular=samples - difference,
        residual=difference + np.fft.irfft(np.where(lines.sidebands, spectrum, 0.0), points),
        difference=difference, amplitudes=weight * np.abs(spectrum), lines=lines)
