"""`python -m experiments.train` and what it cannot use. What it does with the rest is in test_loop.py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from configs import CONFIGS
from experiments.train import main
from kmn_jax.train._loop import Outcome
from tests.train.loop_sample import ONE_DEVICE, flags, run_train, tiny


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Leave the devices of this process as they are, and have relative paths in a folder of the test."""
    monkeypatch.setenv("XLA_FLAGS", ONE_DEVICE)
    monkeypatch.chdir(tmp_path)


def complaint(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Return what the command says as it fails with exit code 2, as one line without a frame."""
    try:
        code = main(list(arguments))
    except SystemExit as error:  # of tyro, which frames what it says
        code = error.code  # type: ignore[assignment]
    output, errors = capsys.readouterr()
    assert (code, output) == (2, "")
    return " ".join("".join(" " if char in "│╭╮╰╯─" else char for char in errors).split())


def test_arguments_are_fields(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    seen: list[Any] = []

    def stopped(*arguments: Any, **options: Any) -> Outcome:
        seen.append((*arguments, options))
        return Outcome(3, "SIGTERM came", None, 0)

    monkeypatch.setattr("experiments.train.train", stopped)
    monkeypatch.setattr("experiments.train.require_made", lambda *folders: None)
    options = {"max_minutes": None, "resume": False}
    for name, config in CONFIGS.items():
        assert main([name]) == 0
        assert seen.pop() == (config, Path("runs") / name, options)
    more = ["--resume", "--max-minutes", "5", "--folder", "a run"]
    capsys.readouterr()
    assert main([*flags(random_seed=7), *more]) == 0
    assert seen == [(tiny(random_seed=7), Path("a run"), {"max_minutes": 5.0, "resume": True})]
    output = capsys.readouterr().out
    assert output.startswith("stopped after step 3 of 6 because SIGTERM came; go on with: python -m experiments.train ")
    assert output.endswith(" --random-seed 7 --max-minutes 5 --folder 'a run' --resume\n")


def test_a_second_interrupt_ends_it_with_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*arguments: Any, **options: Any) -> Outcome:
        raise KeyboardInterrupt

    monkeypatch.setattr("experiments.train.train", interrupted)
    monkeypatch.setattr("experiments.train.require_made", lambda *folders: None)
    assert main(["debug"]) == 130
    assert capsys.readouterr().err == "train: ended at once; --resume goes on with what was saved, if anything was\n"


def test_names_are_listed_and_guessed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    assert ", ".join(CONFIGS) in capsys.readouterr().out
    assert complaint(capsys, "debgu") == "train: there is no config 'debgu': did you mean debug?"
    assert complaint(capsys, "x") == f"train: there is no config 'x': there are {', '.join(CONFIGS)}"
    for misspelt, meant in (("--num-stpes", "--num-steps"), ("--optimizer.learning-rat", "--optimizer.learning-rate")):
        said = complaint(capsys, "debug", misspelt, "3")
        assert f"Unrecognized options: {misspelt}" in said
        assert f"Perhaps you meant: {meant}" in said


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("--num-steps 0", "num_steps = 0 must be at least 1"),
        ("--num-steps many", "--num-steps: invalid literal"),
        ("--random-seed -1", "random_seed = -1 must be from 0"),
        ("--max-minutes -1", "max_minutes = -1.0 must not be negative"),
        ("--pack nowhere", "nowhere/manifest.json cannot be read (No such file or directory): name the folder of a"),
        ("--examples.crops.num-points 32", "examples.crops.num_points = 32 and network.num_scene_points = 64 must be"),
        ("--crops-at-once 3", "crops_at_once = 3 must divide pipeline.crops_per_object = 2, or be a multiple of it"),
        ("--crops-at-once 8", "a batch of 4, in groups of 2 crops of one object, cannot be shared by 1 devices that"),
        ("--pipeline.batch-size 3", "batch_size = 3 must be a multiple of crops_per_object = 2"),
        ("--validation-samples 3", "validation_samples = 3 must be a multiple of pipeline.crops_per_object = 2"),
        ("--optimizer.warmup-steps 3", 'warmup_steps = 3 needs schedule "cosine": "step" has no warm-up'),
        ("--optimizer.schedule cosine --optimizer.warmup-steps 6", "must be fewer than the run's 6 steps"),
        ("--network.groups 5", "edge_width is 16, but must be a multiple of groups = 5"),
        ("--network.inputs row", "invalid choice 'row' for argument '--network.inputs'"),
        ("--processes 2", "coordinator = None, processes = 2 and process = None belong together: give all"),
        ("--coordinator a:1 --processes 2 --process 2", "process = 2 must be from 0 to below processes = 2"),
        ("--folder file", "cannot read the folder of checkpoints"),
    ],
)
def test_values_that_contradict_or_do_not_exist(
    arguments: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("file").write_text("")
    said = complaint(capsys, *flags(), *arguments.split())
    assert sentence in said
    assert "Traceback" not in said
    assert [path.name for path in Path().iterdir()] == ["file"]


def test_a_process_ends_with_the_code_and_without_a_traceback() -> None:
    with run_train("debug", "--pack", "nowhere") as process:
        output, errors = process.communicate(timeout=200)
    assert (process.returncode, output) == (2, "")
    assert errors == (
        "train: nowhere/manifest.json cannot be read (No such file or directory): name the folder of a pack\n"
    )
