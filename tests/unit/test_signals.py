"""Signals to a training: what they ask for is done at the end of an iteration."""

import contextlib
import os
import signal

import pytest
from runs import TINY, assert_same_run, changed, train

import quadrl
from quadrl.base.signals import Stopped, heeded
from quadrl.learning import checkpoint
from quadrl.learning.run import train_in

RARE = changed(checkpoint_seconds=1e9, episodes=1)


@pytest.fixture(autouse=True)
def interruptible():
    """A shell starts what runs in the background with Ctrl-C ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run that nobody disturbed."""
    return train(TINY, tmp_path_factory.mktemp("runs") / "finished")


def sent(*signals, after=2):
    """Sends signals to this process in the iteration after some."""

    def show(progress):
        if progress.iteration == after:
            for number in signals:
                os.kill(os.getpid(), number)

    return show


def run(folder, show, **given):
    return train_in(folder, RARE, resume=False, show=show, **given)


def saved(folder):
    """Iteration of the checkpoint, and steps of the policy."""
    steps = quadrl.Policy.load(folder).metadata["steps"]
    return checkpoint.load(folder / checkpoint.CHECKPOINT)[1]["iteration"], steps


@pytest.mark.slow
@pytest.mark.parametrize(
    "signals",
    [(signal.SIGTERM,), (signal.SIGINT,), (signal.SIGTERM,) * 3, (signal.SIGINT, signal.SIGTERM)],
    ids=str,
)
@pytest.mark.parametrize("after", [2, 6])  # 6 is the last iteration
def test_a_stopped_training_has_a_checkpoint_and_ends_as_if_it_was_not(
    finished, tmp_path, signals, after
):
    before = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)]
    with pytest.raises(Stopped) as caught:
        run(tmp_path, sent(*signals, after=after), heed=heeded)
    assert caught.value.number == signals[0]
    assert saved(tmp_path) == (after, 32 * after)
    assert not (tmp_path / "evaluation.json").exists()
    assert before == [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)]
    assert_same_run(finished, train(RARE, tmp_path, resume=True))


def test_a_checkpoint_is_written_when_it_is_asked_for_and_the_training_goes_on(finished, tmp_path):
    found = []

    def show(progress):
        sent(signal.SIGUSR1)(progress)
        if progress.iteration > 2:
            found.append(saved(tmp_path))

    run(tmp_path, show, heed=heeded)
    assert found == [(2, 64)] * 4  # once, and not again in the iterations after it
    assert_same_run(finished, tmp_path)


def test_a_second_ctrl_c_stops_at_once(tmp_path):
    with pytest.raises(KeyboardInterrupt) as caught:
        run(tmp_path, sent(signal.SIGINT, signal.SIGINT), heed=heeded)
    assert not isinstance(caught.value, Stopped)
    assert not (tmp_path / checkpoint.CHECKPOINT).exists()


def test_a_library_leaves_signals_to_its_caller(tmp_path):
    """As before, the caller's own handler gets them, and Ctrl-C is a KeyboardInterrupt at once."""
    came = []
    before = signal.signal(signal.SIGTERM, lambda number, _: came.append(number))
    try:
        with contextlib.suppress(Stopped):  # it would end the tests
            run(tmp_path / "run", sent(signal.SIGTERM))
    finally:
        signal.signal(signal.SIGTERM, before)
    assert came == [signal.SIGTERM]
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "other", sent(signal.SIGINT))
    assert not (tmp_path / "other" / checkpoint.CHECKPOINT).exists()
