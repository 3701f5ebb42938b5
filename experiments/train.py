"""Train a named config: `python -m experiments.train NAME [--field value ...]`; the names are those of `configs/`.

A run stops between two steps, with everything saved, when it gets SIGTERM or SIGINT (Ctrl-C) or after `--max-minutes`;
`--resume` goes on to the bit. `--export` writes the state of a run to files of under 16 MiB when it stops, and
`--import` begins with them on another machine.
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from configs import CONFIGS, find_config
from kmn_jax.errors import InputError
from kmn_jax.train import NotFiniteError, TrainConfig, initialize_distributed, split_cpu, train


@dataclass(frozen=True)
class Options:
    """How the run is carried out; every field of the config can be given too."""

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    folder: Path | None = None  # of the run; runs/NAME unless given
    max_minutes: float | None = None
    resume: bool = False  # go on with the run in the folder, if there is one
    export: Path | None = None  # folder to write the state to, when the run stops
    import_: Annotated[Path | None, tyro.conf.arg(name="import")] = None  # folder with an exported state to begin with
    coordinator: str | None = None  # host:port of the first of several processes; they find each other on SLURM and MPI
    processes: int | None = None
    process: int | None = None


def main(arguments: list[str] | None = None) -> int:
    """Train: 0 is success, also if stopped; 2 bad input, 1 a failure, each in one sentence on stderr."""
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    try:
        if name.startswith("-"):
            print(f"{__doc__}\nNames: {', '.join(CONFIGS)}. Fields: python -m experiments.train NAME --help")
            return 0 if name in ("-h", "--help") else 2
        options = _parse(name, rest)
        folder = options.folder or Path("runs") / name
        if not initialize_distributed(options.coordinator, options.processes, options.process):
            pipeline, at_once = options.config.pipeline, options.config.crops_at_once
            split_cpu(pipeline.batch_size // max(pipeline.crops_per_object, at_once or 1))
        outcome = train(
            options.config,
            folder,
            max_minutes=options.max_minutes,
            resume=options.resume,
            import_from=options.import_,
            export_to=options.export,
        )
    except (InputError, NotFiniteError) as error:
        print(f"train: {error}", file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1
    if outcome.reason:
        print(
            f"stopped after step {outcome.step} of {options.config.num_steps} because {outcome.reason}; go on with:"
            f" python -m experiments.train {shlex.join([name, *_again(rest)])}"
        )
    else:
        print(f"done: {outcome.step} steps; best validation loss {outcome.best_loss} at step {outcome.best_step}")
    return 0


def _again(arguments: list[str]) -> list[str]:
    """Return the arguments that go on with a run: an export is neither taken nor written a second time."""
    kept, skipped = [], False
    for argument in arguments:
        if not skipped and argument.partition("=")[0] not in ("--resume", "--import", "--export"):
            kept.append(argument)
        skipped = argument in ("--import", "--export")
    return [*kept, "--resume"]


def _parse(name: str, arguments: list[str]) -> Options:
    return tyro.cli(Options, default=Options(find_config(name)), args=arguments, prog=f"experiments.train {name}")


if __name__ == "__main__":
    sys.exit(main())
