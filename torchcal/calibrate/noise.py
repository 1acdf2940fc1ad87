"""What the residuals say about the noise: its independent and its slowly varying part."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.model.sensor import Drift

LAGS = 60
"""Largest distance (pixels) at which the correlation is looked at."""
LEAST_SHARE = 0.003
"""A slowly varying part with less of the variance than this is not told from none."""
COEFFICIENTS = 1000
"""Most splines over one image: shorter correlations are represented by the shortest that fits."""


@dataclass(frozen=True, kw_only=True, slots=True)
class NoiseModel:
    """The noise that the estimate uses."""

    sigma_scale: float
    """Independent noise over the sensor's sigma."""
    drift: Drift


def correlation(
    residuals: Iterable[tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]],
) -> Float[np.ndarray, " lag"]:
    """Mean product of residuals (m^2) at each distance of 0 to ``LAGS`` pixels.

    Args:
        residuals: For each frame the residuals (m) and which of them count.
    """
    products, pairs = torch.zeros(LAGS + 1).double(), torch.zeros(LAGS + 1).double()
    for residual, counted in residuals:
        mask = counted.double()
        product, pair = (_self_overlap(x) for x in (residual.double() * mask, mask))
        ring = _rings(product)
        near = ring <= LAGS
        products.index_add_(0, ring[near].cpu(), product[near].cpu())
        pairs.index_add_(0, ring[near].cpu(), pair[near].cpu())
    return (products / pairs.clamp(min=1.0)).numpy()


def _self_overlap(image: Tensor) -> Tensor:
    """Sum of products with the image shifted by every (v, u), by the fast Fourier transform."""
    padded = [size + LAGS + 1 for size in image.shape]
    spectrum = torch.fft.rfft2(image, s=padded)
    return torch.fft.irfft2(spectrum.abs().square(), s=padded)


def _rings(image: Tensor) -> Tensor:
    """Distance (pixels, rounded) of each shift of ``_self_overlap``."""
    v, u = (torch.fft.fftfreq(n, 1.0 / n, device=image.device) for n in image.shape)
    return torch.hypot(v[:, None], u).round().long()


def noise_model(
    covariance: Float[np.ndarray, " lag"],
    sigma: float,
    *,
    shortest: float,
    largest: float = float("inf"),
) -> NoiseModel:
    """Splits the correlation of residuals into independent noise and a slowly varying part.

    Args:
        covariance: Result of ``correlation`` (m^2).
        sigma: The sensor's typical sigma (m).
        shortest: Shortest correlation length (pixels) that can be represented.
        largest: Largest sigma (m) of the slowly varying part.
    """
    lags = np.arange(1, LAGS + 1)
    values, weight = covariance[1:], 1.0 / np.sqrt(lags)
    lengths = np.geomspace(3.0, LAGS, 40)
    shapes = np.exp(-0.5 * (lags / lengths[:, None]) ** 2)
    power = np.clip((shapes * values) @ weight**2 / (shapes**2 @ weight**2), 0.0, None)
    misfit = ((values - power[:, None] * shapes) * weight) ** 2
    best = int(misfit.sum(1).argmin())
    sigma = max(sigma, 1e-9)
    total = max(float(covariance[0]), 1e-18)
    slow = min(float(power[best]), largest**2, 0.98 * total)
    if slow < LEAST_SHARE * total:
        return NoiseModel(
            sigma_scale=total**0.5 / sigma, drift=Drift(sigma=0.0, pixels=float(LAGS))
        )
    return NoiseModel(
        sigma_scale=(total - slow) ** 0.5 / sigma,
        drift=Drift(sigma=slow**0.5, pixels=max(float(lengths[best]), shortest)),
    )
