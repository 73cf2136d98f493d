"""Hostile files: each is read, or refused with one clear line; none runs anything."""

import hashlib
import json
import math
import os
import pickle
import struct

import numpy as np
import pytest
import torch
from helpers import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from policies import make_remembering
from test_hostile import EXAMPLES, profile, refusal

from quadrl.base.files import BLANK, DIGEST
from quadrl.evaluation.policy import SHIPPED, Policy
from quadrl.evaluation.policy_file import FORMAT, RECURRENT_FORMAT
from quadrl.learning import checkpoint

FORMATS = {"policy": FORMAT, "memory": RECURRENT_FORMAT, "checkpoint": checkpoint.FORMAT}
OURS = {"digest": BLANK.decode(), "format": checkpoint.FORMAT, "numbers": {}}
LOADERS = {"policy": Policy.load, "memory": Policy.load, "checkpoint": checkpoint.load}
every_reader = pytest.mark.parametrize("reader", FORMATS)


def sound_files(folder):
    """Bytes of a file that each reader reads."""
    path = folder / checkpoint.CHECKPOINT
    tensors = {"actor": {"weight": torch.ones(3, 2), "bias": torch.zeros(3)}, "steps": np.arange(4)}
    checkpoint.save(path, tensors, {"iteration": 3})
    policy = (SHIPPED / "hover_ppo.safetensors").read_bytes()
    make_remembering().save(folder / "memory")
    remembers = (folder / "memory").read_bytes()
    return {"policy": policy, "memory": remembers, "checkpoint": path.read_bytes()}


def sealed(content):
    """A file with the digest of what it holds: another would keep the reader from the rest."""
    if (found := DIGEST.search(content)) is None:
        return content
    before, after = content[: found.start(1)], content[found.end(1) :]
    return before + hashlib.sha256(before + BLANK + after).hexdigest().encode() + after


def read_hostile(reader, path, content):
    """Read; a policy that is read gives finite actions."""
    path.write_bytes(sealed(content))
    with refusal():
        read = LOADERS[reader](path)
        if isinstance(read, Policy):
            size = len(read.mean)
            seen = np.array([np.zeros(size), np.full(size, 1e30), np.full(size, -1e3)])
            actions, _ = read.step(seen, read.initial_state(3))
            assert actions.shape == (3, read.action_size) and (np.abs(actions) <= 1).all()


def of_header(header, data=b""):
    """A safetensors file with any header."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


MUTATIONS = st.lists(
    st.tuples(
        st.sampled_from(["flip", "cut", "insert", "repeat", "number"]),
        st.one_of(st.integers(0, 40), st.integers(0, 1200), st.integers(0, 1 << 14)),
        st.binary(min_size=1, max_size=8),
    ),
    min_size=1,
    max_size=4,
)


def mutated(content, mutations):
    for kind, place, new in mutations:
        at = place % max(1, len(content))
        if kind == "flip":
            content = content[:at] + new + content[at + len(new) :]
        elif kind == "cut":
            content = content[:at] + content[at + len(new) :] if place % 2 else content[:at]
        elif kind == "insert":
            content = content[:at] + new + content[at:]
        elif kind == "repeat":
            content = content[:at] + content[at : at + 64] * 2 + content[at + 64 :]
        else:  # the length of the header
            content = new.ljust(8, b"\0") + content[8:]
    return content


@every_reader
def test_a_mutated_file_is_read_or_refused(reader, tmp_path):
    sound = sound_files(tmp_path)[reader]

    @settings(profile, max_examples=2 * EXAMPLES)
    @given(MUTATIONS)
    def check(mutations):
        read_hostile(reader, tmp_path / "file.safetensors", mutated(sound, mutations))

    check()


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=4),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=5,
)
SIZES = {"F32": 4, "F64": 8, "F16": 2, "BF16": 2, "F8_E4M3": 1, "I64": 8, "BOOL": 1, "U8": 1}
NAMES = ["mean", "deviation", "weight_0", "bias_0", "weight_1", "a/b", "a", "/", "", "weight_-1",
         "memory_input_weight", "memory_state_weight", "memory_state_bias"]  # fmt: skip
TENSORS = st.dictionaries(
    st.sampled_from(NAMES),
    st.tuples(st.sampled_from(list(SIZES)), st.lists(st.integers(0, 8), max_size=3)),
    max_size=5,
)


@every_reader
def test_a_file_of_any_header_is_read_or_refused(reader, tmp_path):
    ours = OURS | {"format": FORMATS[reader], "task": "hover", "metadata": {}}
    keys = st.dictionaries(st.sampled_from(list(ours)), JSON, max_size=2)

    @settings(profile, max_examples=2 * EXAMPLES)
    @given(keys, TENSORS, st.binary(min_size=1, max_size=8))
    def check(changes, tensors, fill):
        header, data = {"__metadata__": {"quadrl": json.dumps({**ours, **changes})}}, b""
        for name, (dtype, shape) in tensors.items():
            size = SIZES[dtype] * math.prod(shape)
            place = [len(data), len(data) + size]
            header[name] = {"dtype": dtype, "shape": shape, "data_offsets": place}
            data += (fill * size)[:size]
        read_hostile(reader, tmp_path / "file.safetensors", of_header(header, data))

    check()


class Payload:
    def __reduce__(self):
        return os.system, ("touch ran",)


def nested(*names):
    """Tensors of one number each, one within another."""
    place = {
        name: {"dtype": "F32", "shape": [1], "data_offsets": [4 * k, 4 * k + 4]}
        for k, name in enumerate(names)
    }
    table = {"quadrl": json.dumps(OURS)}
    return of_header({"__metadata__": table} | place, b"\0" * 8)


@every_reader
@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\0" * 8,
        struct.pack("<Q", 2**63) + b"{}",
        struct.pack("<Q", 10**8) + b"{}",
        of_header(b'{"a":' * 100_000),
        of_header({"__metadata__": {"quadrl": "[" * 200_000}}),
        of_header({"__metadata__": {"quadrl": "1" * 5000}}),
        of_header({"__metadata__": {"quadrl": json.dumps({**OURS, "numbers": None})}}),
        nested("a", "a/b"),
        nested("a/b", "a"),
        nested("/", "//"),
        pickle.dumps(Payload()),
    ],
)
def test_a_file_made_to_break_the_reader_is_refused_and_runs_nothing(reader, content, tmp_path):
    (path := tmp_path / "file.safetensors").write_bytes(sealed(content))
    with refused():
        LOADERS[reader](path)
    assert not (tmp_path / "ran").exists()


def test_the_payload_is_alive():
    pickle.loads(pickle.dumps(Payload()))  # whoever unpickles it runs it, here in tmp_path
    assert os.path.exists("ran")
