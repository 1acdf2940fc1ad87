"""How well a job will tell its unknowns, before any image is taken.

The images of the job's frames need not be there: what the model predicts stands for them. The
figures hold for the declared noise and a model that is right; where the job leaves the slowly
varying part of the noise to be found, there is none here, and they are the best that can happen.
"""

import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro

import torchcal
from torchcal.cli.result_files import as_json, without_nan
from torchcal.display.summary import next_view_words


@dataclass(frozen=True, kw_only=True)
class Options:
    """Expected standard deviations of everything that a job declares unknown."""

    job: tyro.conf.Positional[Path]
    """The job: a TOML file."""
    seed: int = 0
    """Of the joint configurations among which the next one is chosen."""
    json: bool = False
    """Print JSON: metres and radians."""


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    try:
        job = torchcal.read_recording(options.job).planned()
        found = torchcal.foresee(job, generator=torch.Generator().manual_seed(options.seed))
    except torchcal.TorchcalError as error:
        print(error, file=sys.stderr)
        sys.exit(2)  # as torchcal itself: the job cannot be read
    if options.json:
        print(as_json(without_nan(as_data(found))))
        return
    print(f"{'unknown':<28} {'before':>12} {'after':>12}")
    for each in found.parameters:
        scale, unit = {"m": (1e3, "mm"), "rad": (1e3, "mrad"), "1": (1e3, "per mille")}[each.unit]
        before, after = scale * each.prior_sigma, scale * each.expected_sigma
        print(f"{each.name:<28} {before:>12.4g} {after:>12.4g} {unit}")
    for words in dict.fromkeys(each.words for each in found.unobservable):
        print(words)
    if found.next_view is not None:
        print(f"one more image would tell most from: {next_view_words(found.next_view)}")


def as_data(found: torchcal.Foresight) -> dict:
    """For other programs."""
    return {
        "parameters": [asdict(each) for each in found.parameters],
        "unobservable": [
            {"words": each.words, "vector": each.vector.tolist()} for each in found.unobservable
        ],
        "next_view": None if found.next_view is None else asdict(found.next_view),
    }


if __name__ == "__main__":
    main()
