"""A network for one part: no object branch, but learned features of its K keypoints, and else `small` as it first was.

What the published comparison's networks trained for each object stand for: it shows what zero-shot costs.

per_object
    Command:   python -m experiments.build_data per-object --folder outputs/packs/PART
                   --cad outputs/test_sets/industrial/models/obj_00000N.ply
               python -m experiments.train per_object --pack outputs/packs/PART --folder runs/PART
    Data:      the PLY file of the test set, not the CAD file that it was made of: keypoints are its first points, and
               an evaluation refuses networks of another file.
    Hardware:  one core of an AMD EPYC beside other work, 2026-11-22: 57 minutes for the bearing housing (N = 1), 33 for
               the gear motor (N = 3).
    Expected:  on validation segmentation 0.980 and 0.992, keypoints 0.554 and 0.462; poses in experiments/RESULTS.md.
"""

from __future__ import annotations

from dataclasses import replace

from configs.small import small

per_object = replace(
    small,
    name="per_object",
    pack="outputs/packs/per_object",
    num_steps=4_000,
    network=replace(small.network, num_keypoints=20, inputs="invariant", object_branch="learned"),
    examples=replace(small.examples, rotate_object=False, object_shift=0.0, object_noise=0.0),
    pipeline=replace(small.pipeline, samples_per_object=640),
    validate_every=500,
    validation_samples=320,
)
