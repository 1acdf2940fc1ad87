"""The report that a person opens first: one file with every picture inside it."""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from PIL import Image

from torchcal.calibrate.decisions import Transaction
from torchcal.calibrate.observability import sentences
from torchcal.calibrate.result import Calibration, FrameComparison, PixelClass, Status
from torchcal.calibrate.update import LEAST_EVIDENCE
from torchcal.display.colours import CLASS_COLOURS, CLASS_WORDS
from torchcal.display.decided import changes_section
from torchcal.display.figures import SHOWN_AS, class_counts
from torchcal.display.job_settings import settings
from torchcal.display.legend import hybrid_swatch
from torchcal.display.report_rows import (
    chance_words,
    glance,
    next_view_rows,
    objects,
    pose_sigma,
    sigma_words,
    verdict_words,
)
from torchcal.display.summary import corrections, decimals, distance_words, next_view_words
from torchcal.display.templates import filled

MOST_PICTURES = 24
"""More frames than this make a file too large to send: the worst ones are shown."""

WIDEST_PICTURE = 1320
"""Pixels; wider pictures are reduced."""

HEADLINES: dict[Status, str] = {
    Status.CONVERGED: "The answer can be used",
    Status.AMBIGUOUS: "Not usable: more than one pose explains the images",
    Status.UNOBSERVABLE: "Not usable: the images do not fix everything that was asked",
    Status.FAILED: "Not usable: no pose explains the images",
}

AT_NOMINAL: dict[Status, str] = {
    Status.CONVERGED: "Compared at the nominal pose, which explains the images",
    Status.FAILED: "Not usable: the nominal pose does not explain the images",
}
"""Where nothing was estimated."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FramePictures:
    """The drawn figures of one frame."""

    hybrid: Image.Image
    comparison: Image.Image


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameSection:
    """One frame as the report shows it."""

    name: str
    counts: dict[PixelClass, int]
    agreement: str
    """Percent of the compared pixels that agree."""
    sigma: str
    hybrid: str
    """A data URI; empty where the picture is left out."""
    comparison: str


def report(calibration: Calibration, pictures: Mapping[int, FramePictures]) -> str:
    """The whole report as HTML.

    Args:
        calibration: The answer.
        pictures: The figures of ``pictured_frames``.
    """
    estimate = calibration.estimate
    here = estimate.Ts_world_sensor[0]
    frames = _sections(calibration, pictures)
    transaction = Transaction.undecided(
        calibration.job.file.name, calibration.job.world, calibration.update
    )
    return filled(
        "report.html.j2",
        calibration=calibration,
        estimate=estimate,
        headline=headline_of(estimate.status, estimated=estimate.estimated),
        glance=glance(calibration),
        corrections=corrections(calibration),
        next_view=next_view_words(calibration.next_view),
        next_rows=next_view_rows(calibration),
        unobservable=sentences(estimate.unobservable),
        alternatives=[
            (distance_words(here, other.Ts_world_sensor[0]), other.score)
            for other in estimate.alternatives
        ],
        frames=frames,
        lead=min(frames, key=lambda frame: agreement(frame.counts)),
        decimals=decimals,
        classes=[
            (each, CLASS_COLOURS[each], CLASS_WORDS[each], SHOWN_AS[each], _swatch(each))
            for each in SHOWN_AS
        ],
        changes=changes_section(transaction, estimate.status),
        objects=objects(calibration),
        verdict_words=verdict_words,
        least_evidence=LEAST_EVIDENCE,
        alpha=calibration.job.alpha,
        chance=chance_words(calibration.job.alpha),
        settings=settings(calibration.job),
        most_pictures=MOST_PICTURES,
    )


def headline_of(status: Status, *, estimated: bool) -> str:
    """What a status says of an answer, or of a comparison at the nominal pose."""
    return HEADLINES[status] if estimated else AT_NOMINAL.get(status, HEADLINES[status])


def agreement(counts: dict[PixelClass, int]) -> float:
    """The share of the compared pixels in which the model agrees; 0 where none was compared."""
    compared = sum(counts.values()) - counts[PixelClass.NOT_COMPARED]
    return counts[PixelClass.AGREES] / max(1, compared)


def pictured_frames(comparisons: Sequence[FrameComparison]) -> frozenset[int]:
    """The frames that a report shows: those that agree least."""
    agreements = [agreement(class_counts(comparison)) for comparison in comparisons]
    worst = sorted(range(len(agreements)), key=agreements.__getitem__)
    return frozenset(worst[:MOST_PICTURES])


def _sections(
    calibration: Calibration, pictures: Mapping[int, FramePictures]
) -> list[FrameSection]:
    counts = [class_counts(comparison) for comparison in calibration.comparisons]
    return [
        FrameSection(
            name=comparison.name,
            counts=counts[index],
            agreement=f"{100.0 * agreement(counts[index]):.1f} %",
            sigma=sigma_words(pose_sigma(calibration, index)),
            hybrid=_embedded(pictures[index].hybrid) if index in pictures else "",
            comparison=_embedded(pictures[index].comparison) if index in pictures else "",
        )
        for index, comparison in enumerate(calibration.comparisons)
    ]


def _embedded(picture: Image.Image) -> str:
    """A picture as a data URI of sensible size."""
    reduced = picture.copy()
    reduced.thumbnail((WIDEST_PICTURE, 4 * WIDEST_PICTURE))
    buffer = io.BytesIO()
    reduced.save(buffer, format="JPEG", quality=85, subsampling=0)  # thin lines keep their colours
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()


def _swatch(member: PixelClass) -> str:
    """What the hybrid view makes of a class, as a data URI."""
    buffer = io.BytesIO()
    Image.fromarray(hybrid_swatch(member)).save(buffer, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
