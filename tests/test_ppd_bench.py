"""The training benchmark tells of the real loop: shares of the whole, none for what is off."""

import pytest
from benchmarks.training import STAGES, _measured, markdown
from ppd_data import write_boxes


def test_shares_are_of_the_whole(tmp_path):
    folder = write_boxes(tmp_path, train=2, test=0, states=1)
    row = _measured("ppd_plain", "cpu", str(folder), 2, 1)
    share = row["share"]
    assert tuple(share) == STAGES
    assert sum(share.values()) == pytest.approx(1.0)
    assert share["backward"] > 0.1
    assert share["forward"] > 0.1
    assert share["discriminator"] == 0.0  # ppd_plain has none
    assert row["iterations_per_second"] > 0
    assert row["peak_bytes"] > 2**27
    about = {"machine": "M", "threads": 1, "torch": "2", "commit": "c", "load": 0.0}
    assert "| ppd_plain | CPU | " in markdown({"about": about, "rows": [row]})
