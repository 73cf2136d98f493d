"""The file for PX4's mc_raptor, read and flown by what RAPTOR's authors publish for Python."""

import tarfile

import numpy as np
import pytest
from policies import make_raptor

from quadrl.core.environment import Environment
from quadrl.core.scenario import UNDISTURBED
from quadrl.deploy.export import export

foundation_policy = pytest.importorskip("foundation_policy")  # pip install foundation-policy
MOTORS = [1, 0, 2, 3]  # of the racer: ahead right, back right, back left, ahead left


class Group:
    """The groups and arrays of a tar, as that library reads them of an HDF5 file."""

    def __init__(self, files, path=""):
        self.files, self.path = files, path

    @property
    def attrs(self):
        text = self.files[f"{self.path}/meta"].decode()
        return dict(line.split(": ", 1) for line in text.splitlines())

    def __len__(self):
        inside = (name[len(self.path) + 1 :] for name in self.files if name.startswith(self.path))
        return len({name.partition("/")[0] for name in inside} - {"meta", "data"})

    def __getitem__(self, key):
        if key != ():
            return Group(self.files, f"{self.path}/{key}".lstrip("/"))
        shape = [int(self.attrs[f"dim_{k}"]) for k in range(int(self.attrs["num_dims"]))]
        return np.frombuffer(self.files[f"{self.path}/data"], "<f4").reshape(shape)


def test_the_authors_reader_flies_as_the_policy_does(tmp_path):
    policy = make_raptor()
    with tarfile.open(export(policy, "raptor", tmp_path / "policy.tar")) as tar:
        root = Group({x.name: tar.extractfile(x).read() for x in tar.getmembers()})
    model = foundation_policy.layer_dispatch(root["actor"])
    assert model.description() == "Sequential(Dense(16), GRU(16), Dense(4))"
    found = model.evaluate(root["example"]["input"][()])
    np.testing.assert_allclose(found, root["example"]["output"][()], rtol=0, atol=1e-5)
    environment = Environment(policy.scenario, num_envs=5, seed=720_000, **UNDISTURBED)
    seen, flight, last = (
        environment.flatten(environment.reset()),
        policy.flying(5),
        np.zeros((5, 4)),
    )
    model.reset()
    for _ in range(60):
        state = environment.snapshot.state
        parts = state.position.clip(-0.5, 0.5), np.reshape(state.rotation, (5, 9))
        moving = state.velocity.clip(-1, 1), state.body_rate
        given = np.concatenate([*parts, *moving, last], axis=1)
        action = flight(seen)
        found = model.evaluate_step(given).clip(-1, 1)
        np.testing.assert_allclose(found, action[:, MOTORS], rtol=0, atol=1e-5)
        seen, last = environment.flatten(environment.step(action).observation), action[:, MOTORS]
