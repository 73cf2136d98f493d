"""The lock of a run folder on a file system without locks."""

import errno
import os
import socket
import subprocess
import sys

import pytest
from helpers import refused

from quadrl.base.errors import QuadrlWarning
from quadrl.learning.folder import LOCK, lock_folder

HERE = socket.gethostname()


@pytest.fixture(params=["ENOSYS", "ENOLCK", "EOPNOTSUPP"])
def folder(request, tmp_path, monkeypatch):
    """A folder whose file system answers as one without locks does."""

    def refuse(descriptor, operation):
        raise OSError(getattr(errno, request.param), "no locks here")

    monkeypatch.setattr("fcntl.flock", refuse)
    return tmp_path


def locked(folder):
    with pytest.warns(QuadrlWarning, match=f"no locks: {LOCK}"):
        return lock_folder(folder)


def test_a_file_takes_the_place_of_the_lock(folder):
    unlock = locked(folder)
    assert (folder / LOCK).read_text().split() == [HERE, str(os.getpid())]
    with refused(match=f"another training works in .*process {os.getpid()} on"):
        lock_folder(folder)  # of this process as well
    unlock()
    assert list(folder.iterdir()) == []
    locked(folder)()


def test_it_is_refused_while_its_process_lives_and_taken_over_when_it_is_dead(folder):
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        owner = f"{HERE} {other.pid}\n"
        (folder / LOCK).write_text(owner)
        with refused(match=f"process {other.pid} on"):
            lock_folder(folder)
        assert (folder / LOCK).read_text() == owner
        other.communicate()
    unlock = locked(folder)
    assert (folder / LOCK).read_text() != owner
    unlock()
    # So is one of an earlier process with the number of this one.
    (folder / LOCK).write_text(f"{HERE} {os.getpid()}\n")
    locked(folder)()


@pytest.mark.parametrize("content", ["elsewhere 12\n", "", "\xff\xfe", f"{HERE} x\n", HERE])
def test_of_another_host_it_is_refused_with_what_to_do(folder, content):
    (folder / LOCK).write_bytes(content.encode("latin-1"))
    with refused(match=rf"on.*{LOCK}.*if that process is gone, delete the file"):
        lock_folder(folder)
    assert (folder / LOCK).read_bytes() == content.encode("latin-1")


def test_only_the_process_that_made_it_removes_it(folder, monkeypatch):
    unlock = locked(folder)
    with monkeypatch.context() as patch:
        patch.setattr("os.getpid", lambda: 12)  # as in a child
        unlock()
    assert (folder / LOCK).exists()


def test_another_error_of_the_system_is_told(tmp_path, monkeypatch):
    def refuse(descriptor, operation):
        raise OSError(errno.EIO, "broken")

    monkeypatch.setattr("fcntl.flock", refuse)
    with pytest.raises(OSError, match="broken"):
        lock_folder(tmp_path)
    assert list(tmp_path.iterdir()) == []
