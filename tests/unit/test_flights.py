"""The C that quadrl/deploy/flights.py writes for the page docs/fly, compiled for this machine."""

import ctypes

import helpers
import numpy as np
import pytest

from quadrl import tasks
from quadrl.aircraft import parameters
from quadrl.aircraft.presets import VEHICLES
from quadrl.base.philox import START
from quadrl.control.geometric import GeometricController
from quadrl.core.environment import Environment
from quadrl.deploy import flights
from quadrl.engines.native import compiling
from quadrl.engines.rng import uniform


class Memory:
    """The memory of a flight, and the functions that work on it."""

    def __init__(self, environment):
        self.numbers = np.zeros(sum(flights.PARTS.values()))
        source, self.drawn = flights.write(environment)
        self._library = compiling.compile_generated("#include <math.h>\n" + exported(source))
        self._prefix = f"{environment.task.name}_{environment.vehicle.name}"
        self["parameters"][:] = parameters.rows(environment.vehicle).view(float)

    def __getitem__(self, part):
        first = flights.LAYOUT[part]
        return self.numbers[first : first + flights.PARTS[part]]

    def read(self, engine):
        """The state, as the engine knows it."""
        assert engine.state is engine.frames[0].state  # which it has filled
        state = engine.frames[0]
        self["state"][: len(state.table)] = state.table[:, 0]

    def call(self, name):
        getattr(self._library, f"{self._prefix}_{name}")(ctypes.c_void_p(self.numbers.ctypes.data))


def exported(source):
    """With its functions visible, since the flags hide them."""
    return source.replace("void ", '__attribute__((visibility("default"))) void ')


@pytest.mark.parametrize("task, vehicle", [("hover", "paper"), ("target_following", "hexa")])
def test_a_flight_is_that_of_the_environment_bit_for_bit(task, vehicle):
    seed, steps = 11, 30
    environment = Environment(task, vehicle=vehicle, engine="free_flight", seed=seed)
    observation = environment.flatten(environment.reset())
    controller = GeometricController(VEHICLES[vehicle], tasks.make(task))
    memory, engine = Memory(environment), environment.engine
    rotors, size = environment.vehicle.rotor_count, environment.size
    memory["scale"][:] = environment.vehicle.action_scale
    memory["drawn"][: memory.drawn] = uniform(
        np.array([seed]), np.array([0]), START, 0, memory.drawn
    )[0]
    memory.call("begin")
    # NumPy's sine is not that of the C library.
    np.testing.assert_allclose(memory["qpos"], engine.qpos[0], rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(memory["qvel"], engine.qvel[0], rtol=1e-14, atol=1e-14)
    np.testing.assert_array_equal(memory["act"][:rotors], engine.act[0])
    memory["modelled"][:rotors] = engine.act[0]  # as the page does with what sees true speeds
    memory.read(engine)
    memory.call("first")
    np.testing.assert_allclose(memory["observation"][:size], observation[0], rtol=1e-6, atol=1e-7)
    for _ in range(steps):
        memory["observation"][:size] = observation[0]
        memory.call("geometric")
        action = controller(observation)
        np.testing.assert_array_equal(memory["action"][:rotors], action[0])
        memory.call("command")
        now = environment.step(action)
        np.testing.assert_array_equal(memory["ctrl"][:rotors], engine.ctrl[0])
        memory.read(engine)
        memory.call("step")
        observation = environment.flatten(now.observation)
        error, reward, *goal = memory["given"][:5]
        # What a path of sines remembers has their last bits.
        np.testing.assert_allclose(error, now.error[0], rtol=1e-11)
        np.testing.assert_allclose(reward, now.reward[0], rtol=1e-11)
        np.testing.assert_allclose(goal, environment.goals()[0], rtol=1e-12)
        np.testing.assert_array_equal(memory["given"][5:], [now.terminated[0], 0, 0])


def test_an_end_is_told():
    environment = helpers.begun(engine="free_flight")
    memory = Memory(environment)
    helpers.idle(environment)
    memory.read(environment.engine)
    memory.call("first")
    memory.call("step")
    assert not memory["given"][5:].any()
    memory["diverged"][:] = 1
    memory.call("step")
    assert memory["given"][5:].tolist() == [1, 0, 0]  # terminated, and nothing else
