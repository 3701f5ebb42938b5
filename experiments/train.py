"""Train a named config: `python -m experiments.train NAME [--field value ...]`; the names are those of `configs/`.

A run stops between two steps, with everything saved, when it gets SIGTERM or SIGINT (Ctrl-C) or after `--max-minutes`;
`--resume` goes on to the bit, also in a copy of the run's folder on another machine.
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from configs import CONFIGS, find_config
from experiments.made_data import require_made
from kmn_jax.errors import InputError
from kmn_jax.geometry import ask_for_fast_selection
from kmn_jax.train import NotFiniteError, TrainConfig, initialize_distributed, split_cpu, train


@dataclass(frozen=True)
class Options:
    """How the run is carried out; every field of the config can be given too."""

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    folder: Path | None = None  # of the run; runs/NAME unless given
    max_minutes: float | None = None
    resume: bool = False  # go on with the run in the folder, if there is one
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
        require_made(options.config.pack, options.config.rendered)
        folder = options.folder or Path("runs") / name
        ask_for_fast_selection()
        if not initialize_distributed(options.coordinator, options.processes, options.process):
            pipeline, at_once = options.config.pipeline, options.config.crops_at_once
            split_cpu(pipeline.batch_size // max(pipeline.crops_per_object, at_once or 1))
        outcome = train(options.config, folder, max_minutes=options.max_minutes, resume=options.resume)
    except (InputError, NotFiniteError) as error:
        print(f"train: {error}", file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1
    except KeyboardInterrupt:
        print("train: ended at once; --resume goes on with what was saved, if anything was", file=sys.stderr)
        return 130
    if outcome.reason:
        again = shlex.join([name, *(argument for argument in rest if argument != "--resume"), "--resume"])
        print(
            f"stopped after step {outcome.step} of {options.config.num_steps} because {outcome.reason}; go on with:"
            f" python -m experiments.train {again}"
        )
    else:
        print(f"done: {outcome.step} steps; best validation loss {outcome.best_loss} at step {outcome.best_step}")
    return 0


def _parse(name: str, arguments: list[str]) -> Options:
    return tyro.cli(Options, default=Options(find_config(name)), args=arguments, prog=f"experiments.train {name}")


if __name__ == "__main__":
    sys.exit(main())
