import numpy as np
import pytest

from kmn_jax.pose import PoseResult, PoseStatus


@pytest.mark.parametrize("status", PoseStatus)
def test_every_status_has_a_reason(status):
    result = PoseResult(np.eye(4), 0.0, 0, 0.0, np.zeros(0, bool), status == PoseStatus.OK, np.int32(status))
    assert result.reason == status.reason
    assert len(result.reason) > 10


def test_a_batch_has_no_single_reason():
    statuses = np.array([0, 2], np.int32)
    result = PoseResult(np.eye(4), 0.0, 0, 0.0, np.zeros(0, bool), statuses == 0, statuses)
    with pytest.raises(ValueError, match="batched"):
        _ = result.reason
