"""Parts that an earlier process made of the same file: their cards, beside the programs that are kept."""

from __future__ import annotations

import contextlib
import hashlib
from pathlib import Path

from kmn_jax.detection._estimator import PoseEstimator
from kmn_jax.errors import InputError
from kmn_jax.objects import CARD_SUFFIX, Part, load_part, save_part
from kmn_jax.programs import kept_folder
from kmn_jax.units import Unit

_MOST = 64  # cards that are kept
_LONGEST = 200_000_000  # bytes of a file that is looked up: with more, making the part takes most of the time


def prepare_kept(estimator: PoseEstimator, source: Path, unit: Unit | None) -> Part:
    """Return what `estimator.prepare` makes of a file, made by an earlier process if there is one like it.

    Nothing is looked up unless programs are kept, see `kmn_jax.programs`; a card is read as it is.
    """
    folder = kept_folder()
    is_card = source.suffix.lower() == CARD_SUFFIX
    if folder is None or is_card or not source.is_file() or source.stat().st_size > _LONGEST:
        return estimator.prepare(source, unit)
    digest = hashlib.sha256(f"{source.name}\n{unit}\n{estimator.digest}\n".encode())
    with contextlib.suppress(OSError):  # then the reader says what is wrong
        digest.update(source.read_bytes())
    card = folder / "parts" / f"{digest.hexdigest()[:32]}.kmn"
    with contextlib.suppress(InputError):
        return load_part(card, estimator.digest)
    part = estimator.prepare(source, unit)
    if not part.origin.any():  # what lies far away is not kept: a card's points are in the file's frame
        with contextlib.suppress(OSError, InputError):
            card.parent.mkdir(exist_ok=True)
            for old in sorted(card.parent.glob("*.kmn"), key=lambda path: -path.stat().st_mtime)[_MOST - 1 :]:
                old.unlink(missing_ok=True)
            save_part(part, card)
    return part
