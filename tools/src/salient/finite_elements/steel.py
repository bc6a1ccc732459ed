"""M-19, a non-oriented silicon steel of 0.36 mm sheets: data for the field computation and the loss estimate.

Magnetisation: DC curve of M-19 as in the material library of FEMM 4.2 ("M-19 Steel"; D. C. Meeker, Finite Element
Method Magnetics), read at the flux densities below.

Loss: the modified Steinmetz equation (J. Reinert, A. Brockmeyer, R. W. De Doncker, IEEE Trans. Ind. Appl. 37(4), 2001)
and an eddy current term, with the parameters that S. D. Sudhoff's Power Magnetic Material Toolbox gives for M19
(G. Shane, S. D. Sudhoff, "Refinements in Anhysteretic Characterization and Permeability Modeling", IEEE Trans. Magn.
46(11), 2010). Its fitted permeability is not used: it ends near 1.4 T, far below what a switched-reluctance machine
drives its poles to.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

MU_0 = 4e-7 * math.pi

DENSITY_KG_M3 = 7402.0

# T, A/m.
_MAGNETISATION = np.array(
    [
        (0.0, 0.0), (0.1, 22.7183), (0.2, 31.8714), (0.3, 38.6006), (0.4, 44.8740), (0.5, 51.4372), (0.6, 58.7530),
        (0.7, 67.2453), (0.8, 77.4201), (0.9, 89.9996), (1.0, 106.201), (1.1, 128.547), (1.2, 163.754),
        (1.25, 191.868), (1.3, 234.834), (1.35, 306.510), (1.4, 435.255), (1.45, 674.912), (1.5, 1108.33),
        (1.55, 1813.09), (1.6, 2801.22), (1.65, 4053.65), (1.7, 5591.11), (1.75, 7448.32), (1.8, 9708.82),
        (1.85, 12486.9), (1.9, 16041.5), (1.95, 21249.4), (2.0, 31313.5), (2.05, 53589.4), (2.1, 88477.5),
        (2.15, 124329.0), (2.2, 159969.0), (2.25, 197752.0), (2.3, 234025.0),
    ]
)  # fmt: skip
# Saturated for good: from there on as air.
_BEYOND_T = 3.0

_HYSTERESIS_J_M3 = 50.691
_FREQUENCY_EXPONENT = 1.3375
_FLUX_DENSITY_EXPONENT = 1.8167
_EDDY_J_S_M3 = 2.7513e-2


class Laminations:
    """Reluctivity of a stack of sheets, parallel to them: of its thickness the fraction `stacking_factor` is steel."""

    def __init__(self, stacking_factor: float):
        flux_density_T, field_A_m = _MAGNETISATION.T
        last_T, last_A_m = flux_density_T[-1], field_A_m[-1]
        flux_density_T = np.append(flux_density_T, last_T + _BEYOND_T)
        field_A_m = np.append(field_A_m, last_A_m + _BEYOND_T / MU_0)
        mean_T = stacking_factor * flux_density_T + (1.0 - stacking_factor) * MU_0 * field_A_m
        # Monotone: the Jacobian of the field problem stays positive definite.
        self._field_A_m = PchipInterpolator(mean_T, field_A_m)
        self._slope = self._field_A_m.derivative()

    def reluctivity(self, square_T2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """nu = H/B in A/(T m) and d nu / d B^2, of the square of the mean flux density."""
        square_T2 = np.maximum(square_T2, 1e-12)
        flux_density_T = np.sqrt(square_T2)
        nu = self._field_A_m(flux_density_T) / flux_density_T
        return nu, (self._slope(flux_density_T) - nu) / (2.0 * square_T2)


def sinusoidal_loss_W_kg(frequency_Hz: Any, flux_density_T: Any) -> Any:
    """Specific loss at a sinusoidal flux density of that amplitude."""
    hysteresis = _HYSTERESIS_J_M3 * frequency_Hz**_FREQUENCY_EXPONENT * flux_density_T**_FLUX_DENSITY_EXPONENT
    eddy = _EDDY_J_S_M3 * 2.0 * (math.pi * frequency_Hz * flux_density_T) ** 2
    return (hysteresis + eddy) / DENSITY_KG_M3


def steinmetz() -> tuple[float, float, float]:
    """k, alpha and beta of k f^alpha B^beta in W/kg, nearest to sinusoidal_loss_W_kg from 50 Hz to 2 kHz and from 0.2 T
    to 1.6 T (least squares of the logarithm)."""
    frequency_Hz, flux_density_T = np.meshgrid(np.geomspace(50.0, 2000.0, 17), np.linspace(0.2, 1.6, 15))
    loss = sinusoidal_loss_W_kg(frequency_Hz, flux_density_T)
    columns = [np.ones(loss.size), np.log(frequency_Hz).ravel(), np.log(flux_density_T).ravel()]
    (log_k, alpha, beta), *_ = np.linalg.lstsq(np.stack(columns, axis=1), np.log(loss).ravel(), rcond=None)
    return math.exp(log_k), float(alpha), float(beta)
