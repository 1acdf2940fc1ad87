"""Which elements of a model are which of an image, decided for all of them together (3.2).

A pair that looks right alone may contradict the others. Measured elements are taken one after the
other; every hypothesis goes on with each of its candidates and with none, and its pose is updated
(eq. 4), so that what was decided narrows what is still to be decided.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry import se3
from torchcal.match.characteristics import Candidates
from torchcal.match.elements import Kind
from torchcal.match.prior_gate import Expectation, Innovation, Prior, moved_to_sensor

HYPOTHESES = 32
"""Most that are carried on."""
HOPELESS = 25.0
"""Difference of log likelihoods from the best beyond which a hypothesis is given up."""
SAME = 0.5
"""Standard deviations between poses within which hypotheses are one."""
CLUTTER = {Kind.POINT: 1.0**3, Kind.LINE: 0.5**2 * 0.5**2, Kind.PLANE: 0.5 * 0.5**2}
"""m and rad: about one element that is not the model's is in so much of each kind's space."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Joint:
    """Hypotheses of what belongs together, the likeliest first."""

    T_sensor_world: Float[Tensor, "hypothesis 4 4"]
    covariance: Float[Tensor, "hypothesis 6 6"]
    """Of a twist (m, rad) on the right of the pose."""
    partner: Int[Tensor, "hypothesis measured"]
    """The model's element of each measured one; -1: none."""
    log_likelihood: Float[Tensor, " hypothesis"]

    def rows(self, chosen: Tensor) -> "Joint":
        """Some of the hypotheses."""
        return Joint(
            T_sensor_world=self.T_sensor_world[chosen],
            covariance=self.covariance[chosen],
            partner=self.partner[chosen],
            log_likelihood=self.log_likelihood[chosen],
        )

    def spread(self) -> Float[Tensor, "6 6"]:
        """How far apart the hypotheses' poses are: the second moment about the likeliest's."""
        share = (self.log_likelihood - self.log_likelihood[0]).softmax(0)
        xi = se3.log(se3.inverse(self.T_sensor_world[0]) @ self.T_sensor_world)
        return (share[:, None] * xi).mT @ xi


def joint_hypotheses(
    expectation: Expectation,
    candidates: Candidates,
    prior: Prior,
    order: Int[Tensor, " step"],
    *,
    gamma: float,
) -> Joint:
    """The likeliest ways to pair measured elements with candidates, and the poses they lead to.

    Args:
        expectation: Both sides.
        candidates: C of eq. 6, by characteristic values.
        prior: The starting value.
        order: Measured elements in the order in which they are taken; what is most telling first.
        gamma: Standard deviations beyond which a pair contradicts a hypothesis.
    """
    T, P = moved_to_sensor(prior)
    now = Joint(
        T_sensor_world=T[None],
        covariance=P[None],
        partner=torch.full((1, candidates.matrix.shape[1]), -1, device=T.device),
        log_likelihood=T.new_zeros(1),
    )
    for other in order.tolist():
        own = candidates.matrix[:, other].nonzero()[:, 0]
        if len(own):
            likelihood = candidates.log_likelihood[own, other]
            now = _apart(_carried_on(expectation, now, own, other, likelihood, gamma))
    return now


def _carried_on(
    expectation: Expectation, now: Joint, own: Tensor, other: int, likelihood: Tensor, gamma: float
) -> Joint:
    """Every hypothesis with each candidate of one measured element, and with none."""
    found = expectation.at(now.T_sensor_world, now.covariance, own, torch.full_like(own, other))
    clutter = math.log(CLUTTER[Kind(int(expectation.measured.kind[0, other]))])
    gain = found.match.log_likelihood + likelihood + clutter
    gain = torch.where(found.match.distance < gamma, gain, -torch.inf)
    gain = torch.cat([torch.zeros_like(gain[:, :1]), gain], 1)
    score = (now.log_likelihood[:, None] + gain).flatten()
    best = score.topk(min(2 * HYPOTHESES, len(score)))
    kept = best.indices[best.values > best.values[0] - HOPELESS]
    parent, choice = kept // gain.shape[1], kept % gain.shape[1] - 1
    grown = now.rows(parent)
    T, P = _updated(grown, found, parent, choice)
    partner = grown.partner.clone()
    partner[:, other] = torch.where(choice >= 0, own[choice], -1)
    return Joint(T_sensor_world=T, covariance=P, partner=partner, log_likelihood=score[kept])


def _updated(
    grown: Joint, found: Innovation, parent: Tensor, choice: Tensor
) -> tuple[Tensor, Tensor]:
    """Poses and covariances after eq. 4; those without a pair stay as they are."""
    is_pair = (choice >= 0).to(grown.covariance)[:, None, None]
    v, A = found.residual[parent, choice], found.jacobian[parent, choice] * is_pair
    P = grown.covariance
    S = A @ P @ A.mT + torch.eye(v.shape[-1]).to(v)
    gain = torch.linalg.solve(S, A @ P).mT
    xi = (gain @ v[..., None])[..., 0]
    left = torch.eye(6).to(P) - gain @ A
    # This form of eq. 4 keeps the covariance definite.
    return grown.T_sensor_world @ se3.exp(xi), left @ P @ left.mT + gain @ gain.mT


def _apart(now: Joint) -> Joint:
    """The likeliest hypotheses, without those at the pose of a likelier one."""
    moved = se3.inverse(now.T_sensor_world[0]) @ now.T_sensor_world
    # Their turns are small: the sine will do.
    turned = torch.stack([moved[:, 2, 1], moved[:, 0, 2], moved[:, 1, 0]], 1)
    xi = torch.cat([moved[:, :3, 3], turned], 1)
    root, _ = torch.linalg.cholesky_ex(now.covariance[0])
    scaled = torch.linalg.solve_triangular(root, xi.mT, upper=False).mT
    again = (torch.cdist(scaled, scaled) < SAME).tril(-1).any(1)
    return now.rows((~again).nonzero()[:HYPOTHESES, 0])
