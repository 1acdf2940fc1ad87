"""Flat regions of a range image, grown on a grid of windows: the largest and surest first."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage, stats

from torchcal.match.image.windows import Windows

AGREE = 3.5 * float(stats.chi2.ppf(0.999, 3))
"""A window whose m differs from a plane's by less, as chi-square, may be a part of it."""
FLAT = 4.0
"""Standard deviations by which the residuals of a window may exceed their expectation."""
SMALLEST = 6
"""Windows that the core of a region must have."""
LOW = 0.1
"""The share of all pairs of windows that surely lie on planes."""
APART = 3
"""Windows between regions that may be one."""
STAGES = (2, 4, 8, 16, 32, 512)
"""How far in windows a region may reach from its seed, one refit after the other."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Regions:
    """Cores of flat regions on the grid of windows."""

    label: Int[ndarray, "row column"]
    """The region of each window; -1 for none."""
    m: Float[ndarray, "region 3"]
    """Normal over distance of each region's plane."""
    excess: float
    """Variance of windows' differences within planes, in units of what the noise explains."""

    def only(self, kept: Bool[ndarray, " region"]) -> "Regions":
        """Some of the regions; the windows of the others have none."""
        place = np.where(kept, np.cumsum(kept) - 1, -1)
        return Regions(label=np.append(place, -1)[self.label], m=self.m[kept], excess=self.excess)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Forms:
    """(m - m_window)^T information (m - m_window) of all windows, as one matrix product."""

    rows: Float[ndarray, "row column term"]
    flat: Bool[ndarray, "row column"]
    agree: float

    def distance(self, m: Float[ndarray, "3"], box: tuple) -> ndarray:
        x, y, z = m
        terms = np.array([x * x, 2 * x * y, 2 * x * z, y * y, 2 * y * z, z * z, *(-2 * m), 1.0])
        return self.rows[box] @ terms

    def fit(self, members: Bool[ndarray, "row column"], box: tuple) -> Float[ndarray, "3"]:
        return _solved(members.ravel() @ self.rows[box].reshape(members.size, -1))


def grow_regions(windows: Windows) -> Regions:
    """Takes windows without bends as seeds and joins what agrees with them within its noise."""
    flat = _flat(windows)
    excess = _excess(windows, flat)
    forms = _forms(windows, flat, AGREE * excess)
    label = np.full(flat.shape, -1)
    free = flat.copy()
    planes: list[ndarray] = []
    for seed in _seeds(flat):
        if not (free[seed] and free[_around(seed, 1)].all()):
            continue
        members, m = _grown(forms, free, seed)
        free &= ~members
        if members.sum() >= SMALLEST:
            label[members] = len(planes)
            planes.append(m)
    return _merged(forms, Regions(label=label, m=np.array(planes).reshape(-1, 3), excess=excess))


def _merged(forms: _Forms, regions: Regions) -> Regions:
    """Joins regions side by side whose windows on the whole agree with one plane, largest first."""
    label, m = regions.label.copy(), regions.m.copy()
    members = [np.nonzero(label == k) for k in range(len(m))]
    sums = [forms.rows[each].sum(0) for each in members]
    for one in np.argsort([-len(rows) for rows, _ in members], kind="stable").tolist():
        for other in _neighbours(label, one):
            plane = _solved(sums[one] + sums[other])
            off = max(_median(forms.distance(plane, members[k])) for k in (one, other))
            if off < forms.agree:
                label[members[other]] = one
                members[one] = _joined(members[one], members[other])
                sums[one] = sums[one] + sums[other]
                m[one] = plane
    merged = Regions(label=label, m=m, excess=regions.excess)
    return merged.only(np.isin(np.arange(len(m)), label))


def _joined(one: tuple[ndarray, ...], other: tuple[ndarray, ...]) -> tuple[ndarray, ...]:
    return tuple(np.concatenate(each) for each in zip(one, other, strict=True))


def _median(values: Float[ndarray, " value"]) -> float:
    ordered = np.sort(values)
    return float(ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2


def _neighbours(label: Int[ndarray, "row column"], one: int) -> Int[ndarray, " region"]:
    """The regions within a few windows of one, the largest first."""
    rows, columns = (np.nonzero((label == one).any(axis))[0] for axis in (1, 0))
    if len(rows) == 0:
        return np.zeros(0, int)
    box = label[
        max(rows[0] - APART, 0) : rows[-1] + APART + 1,
        max(columns[0] - APART, 0) : columns[-1] + APART + 1,
    ]
    around = ndimage.binary_dilation(box == one, iterations=APART)
    names, counts = np.unique(box[around & (box != one) & (box >= 0)], return_counts=True)
    return names[np.argsort(-counts)]


def _flat(windows: Windows) -> Bool[ndarray, "row column"]:
    """Windows whose residuals are no more than noise, at the least that of half of them all."""
    full, chi2 = windows.full.numpy(), windows.chi2.numpy()
    if not full.any():
        return full
    common = max(1.0, float(np.quantile(chi2[full], 0.25)))
    return full & (chi2 < common * (1.0 + FLAT * np.sqrt(2.0 / windows.side**2)))


def _seeds(flat: Bool[ndarray, "row column"]) -> list[tuple[int, int]]:
    """Flat windows amid flat ones, those with most room around first."""
    room = np.asarray(ndimage.distance_transform_edt(np.pad(flat, 1)))[1:-1, 1:-1]
    rows, columns = np.nonzero(room >= 2.0)
    order = np.argsort(-room[rows, columns], kind="stable")
    return list(zip(rows[order].tolist(), columns[order].tolist(), strict=True))


def _around(place: tuple[int, int], reach: int) -> tuple[slice, slice]:
    row, column = place
    return slice(max(row - reach, 0), row + reach + 1), slice(
        max(column - reach, 0), column + reach + 1
    )


def _excess(windows: Windows, flat: ndarray) -> float:
    """By how much windows that do not overlap differ more than their noise explains."""
    step = windows.side // windows.stride
    m, information = windows.m.numpy(), windows.information.numpy()
    apart = m[:, step:] - m[:, :-step]
    covariance = np.linalg.inv(information)
    joint = np.linalg.inv(covariance[:, step:] + covariance[:, :-step])
    chi2 = np.einsum("...i,...ij,...j->...", apart, joint, apart)
    runs = ndimage.minimum_filter1d(flat, 2 * step + 1, axis=1)[:, step // 2 : -step + step // 2]
    chi2 = chi2[runs[:, : chi2.shape[1]]]
    if len(chi2) == 0:
        return 1.0
    return max(1.0, float(np.quantile(chi2, LOW)) / float(stats.chi2.ppf(LOW, 3)))


def _forms(windows: Windows, flat: ndarray, agree: float) -> _Forms:
    m, a = (
        np.nan_to_num(windows.m.numpy()).reshape(-1, 3),
        windows.information.numpy().reshape(-1, 3, 3),
    )
    moment = np.einsum("wij,wj->wi", a, m)
    terms = np.stack(
        [
            a[:, 0, 0],
            a[:, 0, 1],
            a[:, 0, 2],
            a[:, 1, 1],
            a[:, 1, 2],
            a[:, 2, 2],
            *moment.T,
            (m * moment).sum(1),
        ],
        -1,
    )
    return _Forms(rows=terms.reshape(*flat.shape, -1), flat=flat, agree=agree)


def _connected(mask: Bool[ndarray, "row column"]) -> Int[ndarray, "row column"]:
    """A number for each connected part."""
    part = np.zeros(mask.shape, np.int32)
    ndimage.label(mask, output=part)
    return part


def _solved(sums: Float[ndarray, " term"]) -> Float[ndarray, "3"]:
    a, b, c, d, e, f, *moment, _ = sums
    return np.linalg.solve(np.array([[a, b, c], [b, d, e], [c, e, f]]), np.array(moment))


def _grown(forms: _Forms, free: ndarray, seed: tuple) -> tuple[ndarray, ndarray]:
    """The connected windows that agree with the plane through the seed, and that plane."""
    box = _around(seed, 1)
    members = free[box]
    m = forms.fit(members, box)
    for reach in (*STAGES, *STAGES[-1:]):
        box = _around(seed, reach)
        own = seed[0] - box[0].start, seed[1] - box[1].start
        alike = free[box] & (forms.distance(m, box) < forms.agree)
        alike[own] = True
        part = _connected(alike)
        before = members.sum()
        members = part == part[own]
        m = forms.fit(members, box)
        if members.sum() == before:
            break
    everywhere = np.zeros(free.shape, bool)
    everywhere[box] = members
    return everywhere, m
