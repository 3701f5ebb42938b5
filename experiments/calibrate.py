"""Fit the probabilities of detections: `python -m experiments.calibrate [MODEL.safetensors]`.

Poses are searched in the validation bins (`python -m experiments.build_data validation-bins`), whose objects the
network was not trained with, and with `--worlds` and `--known-worlds` in the whole scans of world bins; in each image
also up to three parts of about the same size that are known not to be there; where one hardly differs from a copy, its
pose is neither right nor wrong, and left out. Worlds are given as depth images, as clouds, and as clouds that are cut
out around the copies, as scans often come: those of known parts by turns, the others as images and again otherwise. It
takes hours: name a file by `--candidates`, and what was searched before it is ended, with Ctrl+C, is not searched
again. A model of the evidence is fitted to whether they are right. Probabilities are also predicted by models that were
fitted without the image's object, which gives the reliability that is printed. The model of poses as they are found is
fitted first, to those around the seeds that detection begins with. Then each search is made as a whole, round after
round, by such a model that does not know the image's object, and what it refines is what the model of refined poses is
fitted to. Of known worlds nothing is refined: `experiments.train_verifier` learns from what is found first, so that
what the verifier says there is no evidence. Of refined poses detection reports one for each place: the one that a third
model holds for the most probable, which is fitted to whether all points are in their places (MSSD), and not their mean
(ADI). How probable it is that their mean is, is then said by both together: what lies on another part is seldom in
place in all of its points. Models are too sure of themselves about kinds of objects that they were not fitted to: so
the scales of the refined poses' models are fitted to what detection would report by models that do not know the kind.
From the same poses a fourth model learns what those of one scene say about each other.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from experiments.candidates import poses_to_fit
from experiments.fits import FitOptions, by_largest_error, fit, fit_together, mean_of, predict
from experiments.reliability_picture import save_reliability
from experiments.searches import Sources
from kmn_jax.detection import Probabilities, calibration_beside, load_lightgbm, probabilities_bytes
from kmn_jax.errors import InputError
from kmn_jax.files import write_whole
from kmn_jax.models import PRETRAINED, load_model, load_pretrained
from kmn_jax.programs import call_in_place
from kmn_jax.released import RELEASED
from kmn_jax.report import check_target, print_table, write_json

SHIPPED = calibration_beside(PRETRAINED / f"{RELEASED}.safetensors")


@dataclass(frozen=True)
class Options(FitOptions, Sources):
    """What to fit, on what, and where to write it."""

    model: Annotated[Path | None, tyro.conf.Positional] = None  # .safetensors; the released model unless given
    output: Path | None = None  # the calibration; beside the model unless given
    candidates: Path | None = None  # .npz file to keep the poses in, and a folder beside it
    json: Path | None = None
    picture: Path | None = None  # .png file for the reliability diagram


def calibrate(options: Options) -> dict[str, Any]:
    """Fit, write and print. Raises InputError if there is nothing to fit to."""
    if options.method != "kmn_jax" and options.output is None:
        raise InputError("say where the probabilities of another method shall go: --output FILE")
    if options.judge_anew and (options.candidates is None or not options.candidates.exists()):
        raise InputError("there are no poses to judge anew: name a file of them by --candidates")
    output = options.output or (SHIPPED if options.model is None else calibration_beside(options.model))
    check_target(output, options.candidates, options.json, options.picture)
    load_lightgbm()  # before an hour of searching, not after
    network = load_pretrained() if options.model is None else load_model(options.model)
    poses = poses_to_fit(options, options, network, options.candidates)
    refined = {column: values[poses["refined"]] for column, values in poses.items()}
    found = {column: values[~poses["refined"]] for column, values in poses.items()}
    exact = by_largest_error(refined)
    by_mean, by_largest = (predict(rows, options) for rows in (refined, exact))
    fitted = {
        "found": fit(found, options, predict(found, options)),
        "refined": fit(refined, options, mean_of(by_mean, by_largest)),
        "exact": fit(exact, options, by_largest),
    }
    fitted["together"] = fit_together(refined, fitted["refined"].held_out, options)
    results = {name: one.results for name, one in fitted.items()}
    for name, result in results.items():
        print_table(f"Reliability of poses as {name}, of objects that were not fitted to", result["reliability"])
        print_table(f"Poses as {name}", [result["summary"]])
    probabilities = Probabilities(**{name: one.model for name, one in fitted.items()})
    write_whole(output, probabilities_bytes(probabilities))
    write_json(options.json, results)
    save_reliability({f"poses as {name}": found["reliability"] for name, found in results.items()}, options.picture)
    return results


if __name__ == "__main__":
    call_in_place()
    given = tyro.cli(Options)
    try:
        calibrate(given)
    except InputError as problem:
        sys.exit(f"error: {problem}")
    except KeyboardInterrupt:
        sys.exit(
            "ended: " + ("the same command goes on" if given.candidates else "--candidates FILE keeps what is found")
        )
