"""How far the images' information can be relied on, and how many independent pixels it is worth."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.range_fit import FrameResidual, embedded
from torchcal.calibrate.refine import Refined
from torchcal.geometry import robust
from torchcal.solve.gauss_newton import covariance
from torchcal.solve.image_equations import RobustImage, blockwise_scatter, normal_equations

PROBE = 20.0
"""Standard deviations over which the curvature of the cost is looked at: wider than its ripples."""
NEAR = 0.5
"""Prior sigmas beyond which the cost is not looked at."""
WELL_TOLD = 20.0
"""Of what the images tell, by their own word, so many times better than the prior, each direction
must prove itself."""
FALSE = 1.0 / 3.0
"""With less than this share of the usual curvature nothing is known of a direction: it was told by
wrong slopes alone."""
EXACT = 0.8
"""With this curvature in all directions together and in the weakest, slopes count as right."""
ALONE = 5
"""So many of the weakest directions are looked at one by one where they are not."""
BLOCK = 24
"""Side (pixels) of the blocks whose gradients are taken as independent; longer with drift."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Reliability:
    """What the images tell, as far as it can be relied on."""

    covariance: Float[Tensor, "parameter parameter"]
    """P of eq. 3."""
    used_pixels: int
    """Of all frames: those that the fit went by."""
    independent_pixels: float
    """So many pixels, with errors as large but each its own, would tell as much: the ellipsoid of
    what is told would have the same volume. 0 where nothing is told."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Images:
    """What all frames say at the result."""

    scatter: Float[Tensor, "parameter parameter"]
    """Of the gradients of blocks of pixels."""
    single: Float[Tensor, "parameter parameter"]
    """The information, were each pixel's whole error its own."""
    used: int


@dataclass(frozen=True, kw_only=True, slots=True)
class _Directions:
    """Parameters in which prior and what the images claim to tell are both independent."""

    axes: Float[Tensor, "parameter direction"]
    """1 sigma of the prior long."""
    told: Float[Tensor, " direction"]
    """The images' information along them, ascending: over 1 it is more than the prior's."""

    @staticmethod
    def of(refined: Refined) -> "_Directions":
        """Of a fit, by its own word."""
        information = refined.solution.equations.information[0] - _prior(refined)
        scale = refined.fit.parameters.prior_sigma.to(information)[:, None]
        told, axes = torch.linalg.eigh(scale * information * scale.mT)
        return _Directions(axes=scale * axes, told=told.clamp(min=0.0))

    def more_than(self, limit: float) -> "_Directions":
        """Those of which the images tell more than so many times the prior."""
        kept = self.told > limit
        return _Directions(axes=self.axes[:, kept], told=self.told[kept])


def estimated_covariance(refined: Refined) -> Float[Tensor, "parameter parameter"]:
    """P of eq. 3 after the fit: the prior and as much of the information as can be relied on."""
    return reliability(refined).covariance


def reliability(refined: Refined) -> Reliability:
    """P of eq. 3 after a fit, and the number of independent pixels that it stands for."""
    images, directions = _images(refined), _Directions.of(refined)
    relied = directions.told * _shares(refined, directions, images)
    # The axes span all parameters, so that their inverse is that of the prior's unit ellipsoid.
    inverse = _prior(refined) @ directions.axes
    P = covariance(_prior(refined) + (inverse * relied) @ inverse.mT)
    return Reliability(
        covariance=P,
        used_pixels=images.used,
        independent_pixels=_independent(images, directions, relied),
    )


def reliable_share(refined: Refined) -> float:
    """The share of the images' information that is left when neighbouring errors are alike.

    The gradients of blocks of pixels scatter as the information says if the noise model is right.
    Their excess is what neighbouring errors share beyond it: the information is divided by it.
    What the images say nothing about, such as an object out of view, has no part in it.
    """
    shares = _shares(refined, _Directions.of(refined), _images(refined))
    return float(shares.max()) if len(shares) else 1.0


def _shares(
    refined: Refined, directions: _Directions, images: _Images
) -> Float[Tensor, " direction"]:
    """Of the information along each direction, what can be relied on."""
    seen = directions.more_than(1.0)
    if not len(seen.told):
        return torch.ones_like(directions.told)
    scatter = ((seen.axes.mT @ images.scatter) * seen.axes.mT).sum(1) / seen.told
    curvature = _curvatures(refined, seen)
    real = curvature > FALSE * curvature.median()
    # The variances of all directions, on average: single curvatures are themselves uncertain.
    common = curvature[real].square().reciprocal().mean().rsqrt().nan_to_num(1.0)
    relied = torch.where(real, curvature.clamp(max=common), 0.0)
    rest = common.expand(len(directions.told) - len(relied))
    return torch.cat([rest, relied]).square() / scatter.mean().clamp(min=1.0)


def _curvatures(refined: Refined, seen: _Directions) -> Float[Tensor, " direction"]:
    """Change of the gradient over what it is for Gaussian noise and right slopes, at most 1.

    Noise in the derivatives, from a model that was itself measured or from the flat faces of a
    round one, adds to the information and not to the curvature of the cost. The weakest directions
    live on it most: a cylinder's turn about its axis is told by nothing else.
    """
    everything = torch.arange(len(seen.told), device=seen.told.device)
    together = _curvature(refined, seen, everything)
    weak = (seen.told > WELL_TOLD**2).nonzero()[:, 0][:ALONE]
    found = torch.full_like(seen.told, together)
    if not len(weak):
        return found
    weakest = _curvature(refined, seen, weak[:1])
    if min(together, weakest) > EXACT:
        return found
    found[weak[0]] = weakest
    rest = everything[~torch.isin(everything, weak)]
    for group in (*weak[1:, None], rest):
        if len(group):
            found[group] = _curvature(refined, seen, group)
    return found


def _curvature(refined: Refined, seen: _Directions, group: Tensor) -> float:
    """The same, along the diagonal of some directions: steps to both sides show it."""
    told, axes = seen.told[group], seen.axes[:, group]
    lengths = (PROBE * told.rsqrt()).clamp(max=NEAR) / len(group) ** 0.5
    lengths[1::2] *= -1.0
    step, fit = axes @ lengths, refined.fit
    states = refined.state.expand(2, *refined.state.shape)
    states = fit.parameters.retract(states, torch.stack([step, -step]))
    gradient = fit.evaluate(states).gradient
    fell = 0.5 * (gradient[1] - gradient[0]) @ step - step @ _prior(refined) @ step
    expected = (told * lengths.square()).sum()
    expected = expected * robust.relative_curvature(expected.new_tensor(fit.cutoff))
    return float((fell / expected).nan_to_num(1.0).clamp(0.0, 1.0))


def _images(refined: Refined) -> _Images:
    fit, empty = refined.fit, torch.zeros_like(_prior(refined))
    length = fit.drift.pixels if fit.drift is not None else 0.0
    images = _Images(scatter=empty, single=empty, used=0)
    for frame in fit.residuals(refined.state):
        image = fit.separate(frame)
        scatter = blockwise_scatter(image, frame.jacobian, max(BLOCK, int(3 * length)))
        images = _Images(
            scatter=images.scatter + embedded(scatter, frame.active, len(empty)),
            single=images.single
            + embedded(_single(refined, frame, image), frame.active, len(empty)),
            used=images.used + int((image.precision > 0).sum()) * refined.factor**2,
        )
    return images


def _single(
    refined: Refined, frame: FrameResidual, image: RobustImage
) -> Float[Tensor, "active active"]:
    """An image's information, were each pixel's whole error its own."""
    drift = refined.fit.drift
    slow = 0.0 if drift is None else drift.sigma / refined.factor
    variance = frame.sigma.double().square()
    alone = replace(
        image, precision=image.precision * variance / (variance + slow**2), field=None, system=None
    )
    return normal_equations(alone, frame.jacobian)[0]


def _independent(
    images: _Images, directions: _Directions, relied: Float[Tensor, " direction"]
) -> float:
    """The pixels that were used, over how much more they would tell if they were independent."""
    seen = relied > 1.0
    if not seen.any():
        return 0.0
    axes = directions.axes[:, seen] * relied[seen].rsqrt()
    more = torch.linalg.eigvalsh(axes.mT @ images.single @ axes).clamp(min=1.0)
    return images.used / float(more.log().mean().exp())


def _prior(refined: Refined) -> Float[Tensor, "parameter parameter"]:
    return torch.diag(refined.fit.parameters.prior_precision)
