# SPDX-License-Identifier: GPL-3.0-or-later
"""The outputs of a batch are checked before its first training."""

import pytest

from fdda_addon.core.errors import OutputError
from trainer.outputs import check_batch

from ..core.limb import record_limb


def test_a_file_of_another_kind_is_refused_before_the_first_training(tmp_path):
    recordings = [tmp_path / "r" / name for name in ("body", "sleeve")]
    for recording in recordings:
        record_limb(recording, 4)
    check_batch(recordings, tmp_path / "models")
    (tmp_path / "models" / "sleeve").mkdir(parents=True)
    (tmp_path / "models" / "sleeve" / "report.json").write_text('{"mine": 1}')
    with pytest.raises(OutputError, match=r"report\.json': another file is there, which is not a training report"):
        check_batch(recordings, tmp_path / "models")
    check_batch(recordings, tmp_path / "models", overwrite=True)
