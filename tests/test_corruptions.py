"""A random corruption of each kind of a real data set is found and named, and undone."""

from tests.chaos.corruptions import CORRUPTIONS, trials


def test_every_corruption_is_found_and_can_be_undone(tmp_path):
    tried = list(trials(tmp_path, len(CORRUPTIONS), repaired=len(CORRUPTIONS)))
    assert [trial for trial in tried if not trial.found] == []
    assert [trial for trial in tried if trial.same is False] == []
    assert {trial.fault for trial in tried if trial.same} == set(CORRUPTIONS)
