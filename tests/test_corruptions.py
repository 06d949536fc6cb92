"""Random corruptions of a real data set: all are found and named, and one of each kind undone."""

from tests.chaos.corruptions import CORRUPTIONS, QUICK, trials


def test_every_corruption_is_found_and_can_be_undone(tmp_path):
    tried = list(trials(tmp_path, QUICK, repaired=len(CORRUPTIONS)))
    assert [trial for trial in tried if not trial.found] == []
    assert [trial for trial in tried if trial.same is False] == []
    assert {trial.fault for trial in tried if trial.same} == set(CORRUPTIONS)
