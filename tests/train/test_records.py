from __future__ import annotations

from pathlib import Path

from kmn_jax.train import read_metrics
from kmn_jax.train._records import add_metrics, begin_metrics


def test_rows_are_kept_up_to_where_a_run_goes_on(tmp_path: Path) -> None:
    rows = [(split, step) for step in (2, 4, 6) for split in ("train", "validation")]
    begin_metrics(tmp_path, 0, 0)
    for split, step in rows:
        add_metrics(tmp_path, {"step": step, "split": split, "loss": 1 / 3})
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 4, "split": "train", "loss": [NaN]}\n{"step": 4, "split": "train", "loss": 1e999}\n')
        file.write('{"step": 2, "spl')
    # The run was saved at step 4, before the validation there.
    for _ in range(2):
        begin_metrics(tmp_path, 4, 2)
        add_metrics(tmp_path, {"step": 4, "split": "validation", "loss": 0.5})
        written = [(row["split"], row["step"], row["loss"]) for row in read_metrics(tmp_path)]
        assert written == [(*row, 1 / 3) for row in rows[:3]] + [("validation", 4, 0.5)]
        table = (tmp_path / "metrics.csv").read_text().splitlines()
        assert [line.split(",")[0] for line in table] == ["step", "2", "2", "4", "4"]
        assert table[1] == "2,,train,0.3333333,,,,,,,,"
