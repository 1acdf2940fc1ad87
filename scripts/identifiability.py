"""How well a job will tell its unknowns, before any image is taken.

The images of the job's frames need not be there: what the model predicts stands for them. The
figures hold for the declared noise and a model that is right; where the job leaves the slowly
varying part of the noise to be found, there is none here, and they are the best that can happen.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

import torchcal


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
        print(json.dumps(torchcal.foresight_dict(found), indent=2))
        return
    print(f"{'unknown':<28} {'before':>12} {'after':>12}")
    for each in found.parameters:
        before, after = each.prior_sigma, each.expected_sigma
        print(f"{each.name:<28} {before:>12.4g} {after:>12.4g} {each.unit}")
    for words in dict.fromkeys(each.words for each in found.unobservable):
        print(words)
    if found.next_view is not None:
        print(f"one more image would tell most from: {torchcal.next_view_words(found.next_view)}")


if __name__ == "__main__":
    main()
