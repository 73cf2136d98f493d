"""What the policy of a training reaches along the way."""

import pytest
from runs import Stop, assert_same_run, changed, metrics

import quadrl
from quadrl.learning.run import train_in


def rows(folder):
    return metrics(folder, "evaluations.csv")


def trained(folder, *, last=None, resume=False, **settings):
    def show(progress):
        if progress.iteration == last:
            raise Stop

    given = {"resume": resume, "show": show}
    return train_in(folder, changed(episodes=2, **settings), **given)


def test_policies_are_evaluated_along_the_way_and_end_as_without(tmp_path):
    alone = trained(tmp_path / "alone")
    seen = trained(tmp_path / "seen", evaluations=3)
    assert_same_run(alone.folder, seen.folder)
    assert not (alone.folder / "evaluations.csv").exists()
    found = rows(seen.folder)
    assert [int(row["steps"]) for row in found] == [64, 128, 192]  # of 6 batches of 32
    last = quadrl.evaluate(seen.policy, episodes=50, engine="free_flight").metrics
    assert float(found[-1]["error"]) == last["position_error_m"]
    assert found[0]["error"] != found[-1]["error"]


def test_rows_after_the_checkpoint_are_made_again(tmp_path):
    whole = trained(tmp_path / "whole", evaluations=6)
    with pytest.raises(Stop):  # before the checkpoint of its last iteration
        trained(tmp_path / "run", evaluations=6, last=4)
    assert len(rows(tmp_path / "run")) == 4
    again = trained(tmp_path / "run", evaluations=6, resume=True)
    assert rows(again.folder) == rows(whole.folder) and len(rows(whole.folder)) == 6
